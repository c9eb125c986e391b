"""Rearrangement runs: runs, methods."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

import osfcore.control.closed_loop as adapted_models
import osfcore.control.estimators as estimators
import osfcore.experiments.rearrangement_runs as module
from osfcore.control.estimators import Estimators, load_scene_models
from osfcore.control.events import ActionExecuted, EpisodeSettings, Finished, GoalFound, Observed, Stepped
from osfcore.errors import InvalidInput, OsfError, UnknownName
from osfcore.estimation.steps import EstimateStep
from osfcore.experiments.factors import VariedWorld
from osfcore.experiments.rearrangement_runs import (
    METHODS,
    TRUTHS,
    Ended,
    LoopParts,
    SimulatedModel,
    Variant,
    check_variant,
    loop_parts,
    run_from_images,
    run_told_the_truth,
)
from osfcore.experiments.rivals.nerf import UnlitRenderer
from osfcore.fields.field_library import FieldLibrary
from osfcore.geometry.cameras import default_cameras, goal_camera
from osfcore.geometry.states import EstimatedState
from osfcore.metrics.success import score_of
from osfcore.objects.catalogue import CATALOGUE
from osfcore.paper.rendering import PaperRenderer
from osfcore.paper.stages import STAGES, PaperEstimators
from osfcore.planning.mppi import PlanSettings
from osfcore.progress import Progress
from osfcore.render.renderer import SceneRenderer
from osfcore.world.tabletop import Tabletop
from osfcore.world.tasks import TaskSet, draw_task

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
def worlds(monkeypatch):
    """The worlds that are made, which count their actions."""
    made = []

    def watched(kind):
        class Watched(kind):
            def __init__(self, *args, **more):
                super().__init__(*args, **more)
                self.acted = 0
                made.append(self)

            def act(self, action):
                self.acted += 1
                super().act(action)

        return Watched

    for kind in (Tabletop, VariedWorld):
        monkeypatch.setattr(module, kind.__name__, watched(kind))
    return made


@pytest.fixture
def eyes(monkeypatch, task, worlds):
    """Estimators that know the truth, for real ones take half a minute."""

    def told(state):
        one = np.full(len(state.names), 1e-3)
        estimate = EstimatedState(state, one, one, 1e-3, ("",) * len(state.names), "")
        yield EstimateStep(Progress(1, 1, "Done"), "done", state, estimate=estimate)

    monkeypatch.setattr(estimators, "estimate_first", lambda *_: told(worlds[0].truth()))
    monkeypatch.setattr(estimators, "estimate_next", lambda *_, **__: told(worlds[0].truth()))
    monkeypatch.setattr(adapted_models, "estimate_goal", lambda *_: told(task.goal))


def parts(models):
    return LoopParts(models, Estimators())


def is_closed(world):
    try:
        world.truth()
    except OsfError:
        return True
    return False


def pictures(library, state, cameras):
    world = Tabletop(library)
    try:
        world.restore(state)
        return world.render(cameras, with_pusher=state.pusher is not None).images
    finally:
        world.close()


def test_the_loop_goes_from_the_start_toward_the_goal_image(task, library, models, eyes, worlds):
    events = list(run_from_images(task, library, parts(models), QUICK, np.random.default_rng(0)))
    first, *_, finished, ended = events
    assert isinstance(first, Observed)
    cameras = first.observation.cameras
    assert len(cameras) == len(default_cameras())
    assert first.observation.masks is not None
    np.testing.assert_allclose(first.observation.images, pictures(library, task.start, cameras), atol=1e-6)
    (found,) = (event for event in events if isinstance(event, GoalFound))
    np.testing.assert_allclose(found.image, pictures(library, task.goal, (goal_camera(),))[0], atol=1e-6)
    assert isinstance(finished, Finished)
    assert finished.number == sum(isinstance(event, ActionExecuted) for event in events) == worlds[0].acted == 2
    assert isinstance(ended, Ended)
    assert is_closed(worlds[0])
    np.testing.assert_array_equal(ended.goal, found.image)
    bare = replace(ended.state, pusher=None)
    np.testing.assert_allclose(ended.image, pictures(library, bare, (goal_camera(),))[0], atol=1e-6)


def test_who_is_told_every_truth_needs_no_image(task, library, models, worlds, monkeypatch):
    def refuse(*_args, **_more):
        raise AssertionError("the truth is known")

    for name in ("estimate_first", "estimate_next"):
        monkeypatch.setattr(estimators, name, refuse)
    monkeypatch.setattr(adapted_models, "estimate_goal", refuse)
    few = replace(QUICK, steps=1)
    variant = Variant(truths=frozenset(TRUTHS), views=1)
    events = list(run_from_images(task, library, parts(models), few, np.random.default_rng(0), variant=variant))
    (found,) = (event for event in events if isinstance(event, GoalFound))
    for name in task.moved:
        np.testing.assert_array_equal(found.goal.pose(name).position, task.goal.pose(name).position)
    assert isinstance(events[0], Observed)
    assert len(events[0].observation.cameras) == 1
    last = [event for event in events if isinstance(event, Stepped)][-1]
    ended = events[-1].state
    np.testing.assert_allclose(last.estimate.state.poses.position, ended.poses.position, atol=1e-9)


def test_the_simulator_predicts_what_then_happens(task, library):
    model = SimulatedModel(library, task.start.names)
    world = Tabletop(library)
    action = np.array([0.2, 0.1, 0.0])
    try:
        world.restore(task.start)
        predicted = model.rollout(world.truth(), action[None, None])
        world.act(action)
        np.testing.assert_allclose(predicted.positions[0, 1], world.truth().poses.position, atol=2e-3)
        np.testing.assert_allclose(predicted.pusher[0, 1], world.truth().pusher, atol=1e-6)
    finally:
        model.close()
        world.close()
    assert model.names == task.start.names


def test_an_episode_that_is_left_closes_its_world(task, library, models, eyes, worlds):
    events = run_from_images(task, library, parts(models), QUICK, np.random.default_rng(0))
    next(events)
    assert not is_closed(worlds[0])
    events.close()
    assert is_closed(worlds[0])


@pytest.mark.parametrize("knows_pushes", [True, False])
def test_who_is_told_the_truth_comes_nearer(task, library, models, worlds, knows_pushes):
    settings = EpisodeSettings(steps=12, replan_every=2, plan=PlanSettings(samples=16))
    ended = run_told_the_truth(task, library, models, settings, np.random.default_rng(0), knows_pushes=knows_pushes)
    before, after = (score_of(task, state, models.symmetries).moved_mm for state in (task.start, ended.state))
    assert before > 70
    assert after < before / 2
    assert 0 < worlds[0].acted <= 12
    assert is_closed(worlds[0])
    np.testing.assert_allclose(ended.goal, pictures(library, task.goal, (goal_camera(),))[0], atol=1e-6)
    assert np.abs(ended.image - ended.goal).max() > 0.01


def test_no_more_actions_than_there_may_be(task, library, models, worlds):
    settings = replace(QUICK, steps=3, replan_every=2)
    run_told_the_truth(task, library, models, settings, np.random.default_rng(0), knows_pushes=True)
    assert worlds[0].acted == 3


def test_what_is_at_its_goal_is_left_alone(task, library, models, worlds):
    done = replace(task, goal=replace(task.start, pusher=None))
    ended = run_told_the_truth(done, library, models, QUICK, np.random.default_rng(0), knows_pushes=True)
    assert worlds[0].acted == 0
    assert score_of(done, ended.state, models.symmetries).moved_mm == pytest.approx(0, abs=0.01)
    np.testing.assert_allclose(ended.image, ended.goal, atol=1e-3)


def test_of_each_object_everything_is_known(models, library):
    assert set(models.shapes) == {NAME}
    assert models.symmetries == {NAME: CATALOGUE[NAME].symmetry}
    with pytest.raises(UnknownName, match="teapot"):
        load_scene_models(("teapot",), FieldLibrary(None), library, None)


# Methods


@pytest.mark.parametrize(
    ("variant", "words"),
    [
        (Variant("magic"), "method is 'magic'"),
        (Variant("ours", frozenset({"fields"})), "stages of ours is fields, .*method paper alone"),
        (Variant("paper", frozenset({"hands"})), "stages of ours is hands, .*fields, estimation, dynamics, planning"),
        (Variant("paper", frozenset(STAGES)), "method ours is what replaces all"),
        (Variant("paper", truths=frozenset({"goal"})), "method ours alone"),
        (Variant("ours", truths=frozenset({"luck"})), "poses, goal, dynamics"),
        (Variant(views=0), "number of views is 0"),
        (Variant(views=5), "between 1 and 4"),
        (Variant(has_masks=True), "masks at every step is given"),
        (Variant("paper", frozenset({"planning"}), has_masks=True), "left out"),
        (Variant("foresight", views=2), "which has the goal's view"),
    ],
)
def test_what_cannot_be_combined_is_refused(variant, words):
    with pytest.raises(InvalidInput, match=words):
        check_variant(variant)


def test_variants_that_differ_have_names_that_differ():
    variants = [Variant(method) for method in METHODS]
    variants += [Variant("paper", frozenset({stage})) for stage in STAGES]
    variants += [Variant(truths=frozenset({truth})) for truth in TRUTHS]
    variants += [Variant(views=views) for views in (1, 2, 3)]
    variants.append(Variant("paper", has_masks=True))
    for variant in variants:
        check_variant(variant)
    assert len({variant.name() for variant in variants}) == len(variants)


def test_a_loop_is_made_of_what_its_method_has(library):
    task = draw_task(library, TaskSet((NAME,), objects=1), 1).task
    models = load_scene_models((NAME,), FieldLibrary(None), library, None)

    def made(variant):
        return loop_parts(variant, models, task, FieldLibrary(None), None)

    assert made(Variant()).models is models
    assert made(Variant("known_light")).estimators.first.held_light == tuple(task.start.light.direction)
    assert made(Variant("overhead")).estimators.goal.held_light == (0, 0, 1)
    assert isinstance(made(Variant("nerf")).models.appearance.together, UnlitRenderer)
    published = made(Variant("paper", frozenset({"estimation", "dynamics", "planning"})))
    assert isinstance(published.models.appearance.together, PaperRenderer)
    assert published.models.dynamics is models.dynamics
    assert not isinstance(published.estimators, PaperEstimators)
    looked = made(Variant("paper", frozenset({"fields", "dynamics", "planning"})))
    assert isinstance(looked.models.appearance.together, SceneRenderer)
    assert isinstance(looked.estimators, PaperEstimators)


def test_fields_without_light_are_read_from_the_data_folder_first(tmp_path: Path):
    from osfcore.experiments.rivals.nerf import nerf_library

    assert nerf_library(tmp_path).folder(NAME) == tmp_path / "nerf" / "fields" / NAME
    assert nerf_library(None).info(NAME).source == "shipped"
