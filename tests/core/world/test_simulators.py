"""The choice of a physics engine, and what must hold whichever is chosen."""

import subprocess
import sys
from contextlib import closing
from dataclasses import replace

import numpy as np
import pytest

from osfcore.errors import InvalidInput
from osfcore.extras import MissingExtra
from osfcore.geometry.workspace import PUSHER_RADIUS_M
from osfcore.world.scenes import Conditions, SceneRequest
from osfcore.world.simulated_dynamics import SimulatedPushes
from osfcore.world.simulators import simulate
from osfcore.world.tabletop import Tabletop
from tests.support.errors import about

BOX = "009_gelatin_box"


@pytest.fixture(params=["pybullet", "mujoco"])
def table(request, library):
    """A table with a box that each of the two engines has arranged."""
    pytest.importorskip(request.param)
    conditions = Conditions(simulator=request.param)
    with closing(Tabletop(library, request=SceneRequest(names=(BOX,)), conditions=conditions)) as world:
        world.arrange(3)
        yield world


def before(world):
    """The pusher's place 5 mm beside the box on the side of negative x."""
    state = world.truth()
    left = min(part[:, 0].min() for part in (state.pose(BOX).apply(part) for part in world.assets[BOX].parts))
    return np.array([left - PUSHER_RADIUS_M - 0.005, state.pose(BOX).position[1], state.pusher[2]])


def test_a_seed_repeats_its_scene_and_an_action_its_result(table):
    first = table.truth()
    table.act(np.array([0.2, 0.1, 0]))
    after = table.truth()
    table.arrange(3)
    np.testing.assert_array_equal(table.truth().poses.matrix(), first.poses.matrix())
    table.act(np.array([0.2, 0.1, 0]))
    np.testing.assert_array_equal(table.truth().poses.matrix(), after.poses.matrix())


def test_a_push_moves_the_box_with_the_pusher_and_leaves_it_on_the_table(table):
    table.restore(replace(table.truth(), pusher=before(table)))
    start = table.truth().pose(BOX).position
    for _ in range(3):
        table.act(np.array([0.2, 0, 0]))
    moved = table.truth().pose(BOX).position - start
    assert 0.09 < moved[0] < 0.13  # 0.12 m of the pusher, of which it first walks 5 mm alone
    assert abs(moved[2]) < 0.002


@pytest.mark.parametrize("simulator", ["pybullet", "mujoco"])
def test_predictions_by_an_engine_are_what_it_then_does(simulator, library):
    pytest.importorskip(simulator)
    conditions = Conditions(simulator=simulator)
    with closing(Tabletop(library, request=SceneRequest(names=(BOX,)), conditions=conditions)) as world:
        world.arrange(3)
        world.restore(replace(world.truth(), pusher=before(world)))
        actions = np.tile([0.25, 0.05, 0], (1, 4, 1))
        with closing(SimulatedPushes(world.assets, simulator)) as model:
            predicted = model.rollout(world.truth(), actions)
        for action in actions[0]:
            world.act(action)
        # PyBullet remembers contacts; MuJoCo here does not.
        atol = 0.002 if simulator == "pybullet" else 1e-9
        np.testing.assert_allclose(predicted.positions[0, -1], world.truth().poses.position, atol=atol)


def test_without_pybullet_mujoco_simulates_and_its_renderer_is_refused(library):
    """PyBullet is hidden, as under the Pythons and on the machines that it has no wheels for."""
    program = (
        "import sys; sys.modules['pybullet'] = None; "
        "from osfcore.objects.asset_library import AssetLibrary; "
        "from osfcore.world.scenes import Conditions; from osfcore.world.tabletop import Tabletop; "
        "assets = AssetLibrary(sys.argv[1]); world = Tabletop(assets); "
        "assert world.reset(0).images.max() > 0; print(Conditions().simulator); "
        "Tabletop(assets, conditions=Conditions(renderer='tiny'))"
    )
    told = subprocess.run([sys.executable, "-c", program, library.root], capture_output=True, text=True, check=False)
    assert told.stdout.strip() == "mujoco"
    assert "MissingExtra" in told.stderr.splitlines()[-1]
    assert "pybullet" in told.stderr.splitlines()[-1]


def test_unknown_simulators_are_refused(monkeypatch):
    with pytest.raises(InvalidInput, check=about("simulator")):
        simulate({}, "ode")
    monkeypatch.setitem(sys.modules, "mujoco", None)
    with pytest.raises(MissingExtra):
        simulate({}, "mujoco")
