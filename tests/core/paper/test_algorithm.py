from dataclasses import replace

import numpy as np
import pytest

from osfcore.control.estimators import load_scene_models
from osfcore.control.events import ActionExecuted, Finished, Looking, Observed, Planning, Stepped
from osfcore.control.goal import GoalImage
from osfcore.experiments.rearrangement_runs import TrueEstimators
from osfcore.fields.field_library import FieldLibrary
from osfcore.geometry.cameras import default_cameras, goal_camera
from osfcore.paper.algorithm import AlgorithmSettings, run_algorithm
from osfcore.paper.mppi import GaussianPlanSettings
from osfcore.world.scenes import SceneRequest
from osfcore.world.tabletop import Tabletop

NAME = "009_gelatin_box"
FEW = AlgorithmSettings(2, GaussianPlanSettings(samples=8, horizon=2))


@pytest.fixture(scope="module")
def models(library):
    return load_scene_models((NAME,), FieldLibrary(None), library, None)


def run(library, models, settings, seed=0):
    """Events of an episode whose goal is the start, and the world's truth at its end."""
    world = Tabletop(library, cameras=default_cameras(64), request=SceneRequest(names=(NAME,)))
    try:
        world.arrange(3)
        goal = GoalImage(goal_camera(64), world.render((goal_camera(64),), with_pusher=False).images[0])
        estimators = TrueEstimators(truth=world.truth)
        events = list(run_algorithm(world, models, goal, settings, estimators, np.random.default_rng(seed)))
        return events, world.truth()
    finally:
        world.close()


def test_it_looks_plans_and_acts_until_all_steps_are_done(library, models):
    events, truth = run(library, models, FEW)
    kinds = [type(event) for event in events]
    around = [Observed, Looking, Stepped]
    assert kinds == [*around, *(2 * [Planning, ActionExecuted, *around]), Finished]
    masks = [event.observation.masks is not None for event in events if isinstance(event, Observed)]
    assert masks == [True, False, False]
    finished = events[-1]
    assert (finished.number, finished.outcome) == (2, "out of steps")
    np.testing.assert_allclose(finished.state.poses.position, truth.poses.position, atol=1e-9)
    steps = [event for event in events if isinstance(event, Stepped)]
    assert all(step.offsets_m.size == step.offsets_rad.size == 0 for step in steps)  # no poses of the goal are known
    assert steps[0].image_cost < 5e-3
    plans = [event for event in events if isinstance(event, Planning)]
    assert all(plan.round.actions.shape[0] == 2 for plan in plans)
    events, _ = run(library, models, replace(FEW, has_masks=True))
    assert all(event.observation.masks is not None for event in events if isinstance(event, Observed))
