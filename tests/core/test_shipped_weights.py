"""Every weight file does what is claimed of it: fields relight, and networks predict pushes."""

from collections.abc import Iterator
from contextlib import closing
from dataclasses import replace
from functools import cache

import numpy as np
import pytest

from osfcore.dynamics.graph import read_network, shipped
from osfcore.dynamics.rollout import PushModel, load_shapes
from osfcore.experiments.images import FIELD_METHODS, known_names, load_appearance
from osfcore.experiments.rivals.fitvid import fitvid_path, read_fitvid
from osfcore.experiments.rivals.train_fitvid import action_effect
from osfcore.fields.field_library import FieldLibrary
from osfcore.geometry.cameras import Camera
from osfcore.geometry.light import Light
from osfcore.geometry.rollouts import Rollouts
from osfcore.geometry.states import SceneState
from osfcore.geometry.workspace import PUSHER_CENTRE_Z_M, PUSHER_RADIUS_M
from osfcore.paper.dynamics import load_paper_push_model
from osfcore.render.types import SceneBatch
from osfcore.world.scenes import SceneRequest
from osfcore.world.tabletop import Tabletop

pytestmark = pytest.mark.usefixtures("one_thread")

FIELDS = FieldLibrary(None)
METHODS = [method for method in FIELD_METHODS if method != "nerf_fitted"]  # whose fields are those of "nerf"
SHIPPED = [(method, name) for method in METHODS for name in sorted(known_names(method, FIELDS, None))]
ABOVE = Camera.look_at("above", (0, 0, 0.6), (0, 0, 0), size=64, up=(0.0, 1.0, 0.0))


@pytest.mark.slow
@pytest.mark.parametrize(("method", "name"), SHIPPED)
def test_a_field_seen_from_above_is_brighter_under_a_high_light_and_one_without_light_is_not(method, name):
    """A flat matte top is 1.6 times as bright under a light overhead as under one at 30 deg."""
    lights = np.array([Light.from_angles(0.5, np.deg2rad(elevation)).direction for elevation in (30, 90)])
    batch = SceneBatch((name,), np.zeros((2, 1, 3)), np.tile([1.0, 0, 0, 0], (2, 1, 1)), lights, None)
    rendered = load_appearance(method, (name,), FIELDS, None).alone.render(batch, (ABOVE,), outputs={"masks"})
    assert rendered.masks is not None
    shown = rendered.masks[0, 0, 0]
    assert shown.sum() > 30
    low, high = rendered.rgb[:, 0, shown]
    if method == "nerf":
        np.testing.assert_array_equal(low, high)
    else:
        assert 1.2 < high.mean() / low.mean() < 1.7


@cache
def pushes(library) -> tuple[tuple[SceneState, np.ndarray, SceneState], ...]:
    """Ten pushes through single objects: before, the actions, and after."""

    def done() -> Iterator[tuple[SceneState, np.ndarray, SceneState]]:
        with closing(Tabletop(library, request=SceneRequest(count=1))) as world:
            for seed in range(10):
                world.arrange(seed)
                start = world.truth()
                angle = 2.4 * seed
                way = np.array([np.cos(angle), np.sin(angle), 0.0])
                gap = np.hypot(*library.size_m(start.names[0])[:2]) / 2 + PUSHER_RADIUS_M + 0.01
                place = start.poses.position[0] - gap * way
                start = replace(start, pusher=np.array([*place[:2], PUSHER_CENTRE_Z_M]))
                world.restore(start)
                actions = np.tile(0.2 * way, (4, 1))
                for action in actions:
                    world.act(action)
                yield start, actions, world.truth()

    return tuple(done())


@pytest.mark.slow
@pytest.mark.parametrize(("network", "share"), [("pushes", 0.3), ("pushes_without_two", 0.3), ("as published", 1.0)])
def test_a_network_predicts_pushes_better_than_no_motion(library, network, share):
    names = library.names()
    if network == "as published":
        model = load_paper_push_model(None, FIELDS, names)
    else:
        model = PushModel(read_network(shipped(network)), load_shapes(None, FIELDS, names))
    errors, ways = [], []
    for start, actions, end in pushes(library):
        found: Rollouts = model.rollout(start, actions[None])
        errors.append(np.linalg.norm(found.positions[0, -1, 0] - end.poses.position[0]))
        ways.append(np.linalg.norm(start.poses.position[0] - end.poses.position[0]))
    assert np.mean(ways) > 0.03
    assert np.mean(errors) < share * np.mean(ways)


@pytest.mark.slow
def test_predicted_images_depend_on_actions(library):
    effect = action_effect(read_fitvid(fitvid_path(None)), library, library.names(), seed=1)
    assert effect["true"] > 0.01
    assert effect["predicted"] > effect["true"] / 3
