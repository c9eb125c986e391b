from dataclasses import replace
from itertools import pairwise

import numpy as np
import pytest

from osfcore.control.estimators import Estimators, load_scene_models
from osfcore.control.events import ActionExecuted, EpisodeSettings, GoalFound, Stepped
from osfcore.errors import InvalidInput
from osfcore.experiments import rearrangement_runs as runs
from osfcore.experiments.rivals.nerf import UnlitRenderer
from osfcore.fields.field_library import FieldLibrary
from osfcore.geometry.cameras import goal_camera
from osfcore.metrics.success import score_of
from osfcore.paper.rendering import PaperRenderer
from osfcore.paper.stages import STAGES, PaperEstimators
from osfcore.planning.mppi import PlanSettings
from osfcore.render.renderer import SceneRenderer
from osfcore.world.tabletop import Tabletop
from osfcore.world.tasks import TaskSet, draw_task
from tests.support.errors import about

# Runs


NAME = "009_gelatin_box"
QUICK = EpisodeSettings(steps=2, plan=PlanSettings(samples=8, horizon=4), despite_doubts=True)


@pytest.fixture(scope="module")
def task(library):
    return draw_task(library, TaskSet((NAME,), objects=1), 1).task


@pytest.fixture(scope="module")
def models(library):
    return load_scene_models((NAME,), FieldLibrary(None), library, None)


@pytest.fixture
def world(library):
    world = Tabletop(library)
    yield world
    world.close()


def pictures(world, state, cameras):
    world.restore(state)
    return world.render(cameras, with_pusher=state.pusher is not None).images


def test_the_loop_goes_from_the_start_toward_the_goal(task, library, models, world):
    """With every truth in the place of estimates, which take half a minute."""
    variant = runs.Variant(truths=frozenset(runs.TRUTHS), views=1)
    parts = runs.LoopParts(models, Estimators())
    events = list(runs.run_from_images(task, library, parts, QUICK, np.random.default_rng(0), variant=variant))
    first, *_, finished, ended = events
    cameras = first.observation.cameras
    assert len(cameras) == 1
    assert first.observation.masks is not None
    np.testing.assert_allclose(first.observation.images, pictures(world, task.start, cameras), atol=1e-6)
    (found,) = (event for event in events if isinstance(event, GoalFound))
    for name in task.moved:
        np.testing.assert_array_equal(found.goal.pose(name).position, task.goal.pose(name).position)
    assert finished.number == sum(isinstance(event, ActionExecuted) for event in events) == 2
    for before, event in pairwise(events):
        if isinstance(event, Stepped):
            assert isinstance(before, runs.TrueState)
            np.testing.assert_array_equal(event.estimate.state.poses.position, before.state.poses.position)
    np.testing.assert_allclose(ended.goal, pictures(world, task.goal, (goal_camera(),))[0], atol=1e-6)
    bare = replace(ended.state, pusher=None)
    np.testing.assert_allclose(ended.image, pictures(world, bare, (goal_camera(),))[0], atol=1e-6)


@pytest.mark.slow
@pytest.mark.parametrize("knows_pushes", [True, False])
def test_with_true_poses_it_comes_nearer(task, library, models, world, knows_pushes):
    settings, rng = EpisodeSettings(steps=12, replan_every=2, plan=PlanSettings(samples=16)), np.random.default_rng(0)
    ended = runs.run_told_the_truth(
        task, library, models, settings, rng, knows_pushes=knows_pushes, simulator="pybullet"
    )
    before, after = (score_of(task, state, models.symmetries).moved_mm for state in (task.start, ended.state))
    assert before > 70
    assert after < before / 2
    np.testing.assert_allclose(ended.goal, pictures(world, task.goal, (goal_camera(),))[0], atol=1e-6)
    assert np.abs(ended.image - ended.goal).max() > 0.01


def test_what_is_at_its_goal_is_left_alone(task, library, models):
    done = replace(task, goal=replace(task.start, pusher=None))
    ended = runs.run_told_the_truth(
        done, library, models, QUICK, np.random.default_rng(0), knows_pushes=True, simulator="mujoco"
    )
    assert score_of(done, ended.state, models.symmetries).moved_mm == pytest.approx(0, abs=0.01)
    np.testing.assert_allclose(ended.image, ended.goal, atol=1e-3)


# Methods


@pytest.mark.parametrize(
    ("variant", "subject"),
    [
        (runs.Variant("magic"), "method"),
        (runs.Variant("ours", frozenset({"fields"})), "stages of ours"),
        (runs.Variant("paper", frozenset({"hands"})), "stages of ours"),
        (runs.Variant("paper", frozenset(STAGES)), "stages of ours"),
        (runs.Variant("paper", truths=frozenset({"goal"})), "truth"),
        (runs.Variant("ours", truths=frozenset({"luck"})), "truth"),
        (runs.Variant(views=0), "views"),
        (runs.Variant(views=5), "views"),
        (runs.Variant(has_masks=True), "masks"),
        (runs.Variant("paper", frozenset({"planning"}), has_masks=True), "masks"),
        (runs.Variant("foresight", views=2), "views"),
    ],
)
def test_what_cannot_be_combined_is_refused(variant, subject):
    with pytest.raises(InvalidInput, check=about(subject)):
        runs.check_variant(variant)


def test_variants_that_differ_have_names_that_differ():
    variants = [runs.Variant(method) for method in runs.METHODS]
    variants += [runs.Variant("paper", frozenset({stage})) for stage in STAGES]
    variants += [runs.Variant(truths=frozenset({truth})) for truth in runs.TRUTHS]
    variants += [runs.Variant(views=views) for views in (1, 2, 3)]
    variants.append(runs.Variant("paper", has_masks=True))
    for variant in variants:
        runs.check_variant(variant)
    assert len({variant.name() for variant in variants}) == len(variants)


def test_a_loop_is_made_of_what_its_method_has(task, models):
    def made(variant):
        lights = task.start.light, task.goal.light
        return runs.loop_parts(variant, models, FieldLibrary(None), None, lights)

    assert made(runs.Variant()).models is models
    assert made(runs.Variant("known_light")).estimators.first.held_light == tuple(task.start.light.direction)
    assert made(runs.Variant("overhead")).estimators.goal.held_light == (0, 0, 1)
    assert isinstance(made(runs.Variant("nerf")).models.appearance.together, UnlitRenderer)
    published = made(runs.Variant("paper", frozenset({"estimation", "dynamics", "planning"})))
    assert isinstance(published.models.appearance.together, PaperRenderer)
    assert published.models.dynamics is models.dynamics
    assert not isinstance(published.estimators, PaperEstimators)
    looked = made(runs.Variant("paper", frozenset({"fields", "dynamics", "planning"})))
    assert isinstance(looked.models.appearance.together, SceneRenderer)
    assert isinstance(looked.estimators, PaperEstimators)
