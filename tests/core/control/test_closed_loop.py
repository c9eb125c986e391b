"""Closed loop: closed loop, relocalization, adapted models, monitor."""

from collections import Counter
from dataclasses import replace

import numpy as np
import pytest

from osfcore.control import closed_loop as module
from osfcore.control import estimators
from osfcore.control.closed_loop import (
    AdaptedModels,
    Episode,
    ProgressMonitor,
    estimate_goal_image,
    lamp_moved,
    lies_otherwise,
    moved_by_hand,
    offsets,
    relocalize,
)
from osfcore.control.events import (
    ActionExecuted,
    EpisodeSettings,
    Finished,
    GoalFound,
    Looking,
    Noticed,
    Planning,
    Stepped,
)
from osfcore.control.goal import GoalImage
from osfcore.errors import InvalidInput
from osfcore.estimation.camera_response import ImageModel, srgb_of_linear
from osfcore.estimation.steps import EstimateStep
from osfcore.geometry.cameras import Camera, goal_camera
from osfcore.geometry.light import Light
from osfcore.geometry.poses import Pose, quaternion_exp
from osfcore.geometry.states import SceneState
from osfcore.planning.costs import PoseGoal
from osfcore.planning.mppi import PlanSettings
from osfcore.progress import Progress
from tests.core.control.scenes import CAN, GELATIN, LIGHT, NAMES, models, perfect_fit, sure, table

# Closed loop


DARK = ImageModel(np.full(3, 0.67), 1.0, np.ones(3), "srgb")
SMALL = EpisodeSettings(steps=12, plan=PlanSettings(samples=48, horizon=10))
KNOWN = models()


@pytest.fixture
def world(library):
    world = table(library)
    yield world
    world.close()


@pytest.fixture
def told(world, monkeypatch):
    """Estimators that are told the truth at once, with doubts that a test may set."""
    doubts: dict[str, tuple[str, ...]] = {}

    def steps(look, state):
        yield EstimateStep(Progress(1, 1, "Done"), "done", state, estimate=sure(state, doubts.get(look)))

    monkeypatch.setattr(estimators, "estimate_first", lambda *_: steps("first", world.truth()))
    monkeypatch.setattr(estimators, "estimate_next", lambda *_, usual: steps("next", world.truth()))
    monkeypatch.setattr(module, "relocalize", lambda *_: steps("search", world.truth()))
    monkeypatch.setattr(module, "expected_fit", lambda *_: perfect_fit(len(NAMES)))
    return doubts


def shifted(world, name=GELATIN, shift=(0.0, 0.0)) -> PoseGoal:
    state = world.truth()
    pose = state.pose(name)
    return PoseGoal.of(state, {name: Pose(pose.position + [*shift, 0.0], pose.quaternion)})


def toward_middle(world, name=GELATIN, length=0.08) -> PoseGoal:
    place = world.truth().pose(name).position[:2]
    return shifted(world, name, -length * place / np.linalg.norm(place))


def begun(world, goal, settings=SMALL, **more) -> Episode:
    return Episode(world, KNOWN, goal, settings, np.random.default_rng(0), **more)


class Blind:
    """A world that does not say where its pusher is."""

    def __init__(self, world):
        self.reset, self.act, self.close = world.reset, world.act, world.close
        self._world = world

    def observe(self, *, masks=False):
        return replace(self._world.observe(masks=masks), pusher=None)


def test_a_world_must_say_where_its_pusher_is(world, told):
    with pytest.raises(InvalidInput, match="pusher"):
        list(begun(Blind(world), shifted(world)).run())


@pytest.mark.slow
def test_the_table_becomes_what_was_asked_for(world, told):
    goal = toward_middle(world)
    events = list(begun(world, goal).run())
    left = np.linalg.norm(goal.offsets_m(world.truth()), axis=1)
    assert left.max() < 0.02
    assert isinstance(events[-1], Finished)
    acted = [event.number for event in events if isinstance(event, ActionExecuted)]
    assert acted == list(range(1, events[-1].number + 1))
    steps = [event for event in events if isinstance(event, Stepped)]
    assert [step.number for step in steps] == [0, *acted]
    assert steps[-1].offsets_m.max() == pytest.approx(left.max(), abs=1e-9)
    assert steps[-1].image_cost < 0.3 * steps[0].image_cost
    kinds = Counter(type(event) for event in events)
    assert kinds[GoalFound] == 1
    assert len(acted) < kinds[Planning] < 2 * len(acted)  # some plans only refine the last one
    assert all(set(step.seconds) == {"estimate", "plan", "act"} for step in steps[1:])


def test_a_goal_that_is_met_ends_at_once(world, told):
    *_, last = events = list(begun(world, shifted(world)).run())
    assert (last.outcome, last.number) == ("reached", 0)
    assert not any(isinstance(event, (Planning, ActionExecuted)) for event in events)


@pytest.mark.parametrize("despite", [False, True])
def test_a_goal_image_that_is_not_explained_moves_nothing_unless_told_to(world, told, monkeypatch, despite):
    goal = toward_middle(world)
    state = replace(world.truth(), poses=goal.poses, pusher=None)
    found = sure(state, ("it differs", ""))
    step = EstimateStep(Progress(1, 1, "Done"), "done", state, estimate=found)
    monkeypatch.setattr(module, "estimate_goal_image", lambda *_: iter([step]))
    monkeypatch.setattr(module, "prefer_current_poses", lambda _models, _goal, found, _now: found)
    image = GoalImage(goal_camera(), np.zeros((128, 128, 3), np.float32))
    settings = replace(SMALL, steps=1, despite_doubts=despite)
    *_, last = events = list(begun(world, image, settings).run())
    assert any(isinstance(event, Noticed) and event.matter == "goal" for event in events)
    assert last.outcome == ("out of steps" if despite else "refused")
    assert any(isinstance(event, ActionExecuted) for event in events) == despite


def test_objects_of_another_scene_are_refused_before_anything_moves(world, told):
    before = world.truth()
    goal = PoseGoal(("025_mug", CAN), before.poses)
    with pytest.raises(InvalidInput, match="objects of the goal"):
        list(begun(world, goal).run())
    np.testing.assert_array_equal(world.truth().pusher, before.pusher)


def test_without_acting_plans_are_shown_and_nothing_moves(world, told):
    before, seen = world.truth(), []
    events = begun(world, toward_middle(world), replace(SMALL, acting=False)).run()
    for event in events:
        seen.append(event)
        if sum(isinstance(one, Stepped) for one in seen) == 3:
            break
    events.close()
    assert sum(isinstance(event, Planning) for event in seen) == 2 + 1  # rounds of two plans
    assert not any(isinstance(event, ActionExecuted) for event in seen)
    np.testing.assert_array_equal(world.truth().poses.position, before.poses.position)


def test_without_planning_the_last_plan_is_followed_to_its_end(world, told):
    episode = begun(world, toward_middle(world), replace(SMALL, steps=5))
    plans, actions = [], []
    for event in episode.run():
        if isinstance(event, Planning):
            plans.append(event.round.actions)
        if isinstance(event, ActionExecuted):
            actions.append(event.action)
            episode.settings = replace(episode.settings, planning=False)
    assert len(plans) == 2
    np.testing.assert_allclose(actions, plans[-1][:5], atol=1e-12)


def test_a_plan_serves_for_as_many_actions_as_asked(world, told):
    events = list(begun(world, toward_middle(world, length=0.15), replace(SMALL, steps=5, replan_every=2)).run())
    assert sum(isinstance(event, Planning) for event in events) == 2 + 1 + 1  # rounds of three plans
    assert sum(isinstance(event, ActionExecuted) for event in events) == 5


@pytest.mark.slow
def test_settings_count_from_the_next_step_on(world, told):
    episode = begun(world, toward_middle(world, length=0.15))
    for event in episode.run():
        if isinstance(event, ActionExecuted) and event.number == 2:
            episode.settings = replace(episode.settings, steps=3)
    assert event.number == 3


def test_nothing_coming_nearer_is_noticed(world, told):
    events = list(begun(world, toward_middle(world), replace(SMALL, steps=18, planning=False)).run())
    stalled = [event for event in events if isinstance(event, Noticed) and event.matter == "stalled"]
    assert [event.number for event in stalled] == [17]


@pytest.mark.parametrize(("renewed", "actions"), [(True, 3), (False, 2)])
def test_a_lamp_and_an_object_moved_by_hand_are_noticed_and_renew_the_number_of_steps(world, told, renewed, actions):
    goal, notices = toward_middle(world), []
    for event in begun(world, goal, replace(SMALL, steps=2, planning=False, renewed=renewed)).run():
        if isinstance(event, ActionExecuted) and event.number == 1:
            world.set_light(Light.from_angles(LIGHT.direction[0] + 2.0, 0.6))
            truth = world.truth()
            far = max(NAMES, key=lambda name: np.linalg.norm((truth.pose(name).position - truth.pusher)[:2]))
            pose = truth.pose(far)
            world.move_object(far, Pose(pose.position + [0.0, 0.04, 0.0], pose.quaternion))
        if isinstance(event, Noticed):
            notices.append(event)
    assert [notice.matter for notice in notices] == ["lamp", "object"]
    assert notices[1].names == (far,)
    assert (event.number, event.outcome) == (actions, "out of steps")


def test_what_stays_doubtful_is_looked_for_once_the_pusher_made_room(world, told):
    seen, looks = [], []
    for event in begun(world, toward_middle(world), replace(SMALL, steps=6, planning=False)).run():
        told["next"] = ("it is hardly visible", "") if not looks.count("search") else ("", "")
        seen.append(event)
        looks += [event.look] if isinstance(event, Looking) else []
    matters = [event.matter for event in seen if isinstance(event, Noticed)]
    assert matters[:2] == ["lost", "found"]
    assert looks.count("search") == 1
    retreat = [event.action for event in seen if isinstance(event, ActionExecuted) and np.any(event.action)]
    assert len(retreat) == 2


def test_the_first_look_needs_masks_unless_it_is_known(world, told):
    state = world.truth()
    events = list(begun(world, shifted(world), start=sure(state)).run())
    assert not any(isinstance(event, Looking) for event in events)
    assert events[0].observation.masks is None


class DarkCameras:
    """A world whose cameras hand over sRGB values at two thirds of the exposure."""

    def __init__(self, world):
        self._world, self.act = world, world.act

    def observe(self, *, masks=False):
        seen = self._world.observe(masks=masks)
        return replace(seen, images=srgb_of_linear(DARK.gain * seen.images))


def test_the_image_model_of_the_first_frame_holds_for_later_ones(world, told, monkeypatch):
    """Later frames come at the usual exposure again, and the goal is compared with a table of the usual look."""
    done = EstimateStep(Progress(1, 1, "Done"), "done", world.truth(), estimate=sure(world.truth()))
    first = replace(done, image_model=DARK)
    later = []

    def next_steps(models, seen, *_, usual):
        later.append(seen)
        return iter([done])

    monkeypatch.setattr(estimators, "estimate_first", lambda *_: iter([first]))
    monkeypatch.setattr(estimators, "estimate_next", next_steps)
    events = list(begun(DarkCameras(world), toward_middle(world), replace(SMALL, steps=1)).run())
    np.testing.assert_allclose(later[-1].images, world.observe().images, atol=1e-4)
    (told_of,) = (event for event in events if isinstance(event, Noticed))
    assert told_of.matter == "pictures"
    assert "sRGB" in told_of.text


@pytest.mark.slow
def test_by_real_eyes_later_frames_of_odd_pictures_are_right(world):
    """Nobody tells that the cameras encode and expose otherwise; poses are right before and after a push."""
    goal = toward_middle(world)
    stepped = [e for e in begun(DarkCameras(world), goal, replace(SMALL, steps=3)).run() if isinstance(e, Stepped)]
    truth = world.truth()
    assert stepped[-1].number == 3
    assert stepped[-1].estimate.trusted, stepped[-1].estimate.reason
    for name in NAMES:
        assert stepped[-1].estimate.state.pose(name).position == pytest.approx(truth.pose(name).position, abs=0.005)


def test_by_real_eyes_a_lamp_and_an_object_moved_by_hand_are_survived(world):
    """The pusher stands still; somebody else moves lamp and can. Both are found again."""
    start, goal = sure(world.truth()), shifted(world, CAN, (0.0, 0.06))
    light = Light.from_angles(-1.8, 0.8)
    last = None
    for event in begun(world, goal, replace(SMALL, steps=3, planning=False), start=start).run():
        if isinstance(event, ActionExecuted) and event.number == 1:
            world.set_light(light)
        if isinstance(event, ActionExecuted) and event.number == 2:
            pose = world.truth().pose(CAN)
            world.move_object(CAN, Pose(pose.position + [0.03, 0.02, 0.0], pose.quaternion))
        last = event if isinstance(event, Stepped) else last
    assert last.estimate.trusted
    assert np.arccos(last.estimate.state.light.direction @ light.direction) < np.deg2rad(5)
    truth = world.truth()
    for name in NAMES:
        assert last.estimate.state.pose(name).position == pytest.approx(truth.pose(name).position, abs=0.005)


# Relocalization


def looks_at(position, target):
    return Camera.look_at(f"{position}", np.array(position), np.array(target), size=64)


def test_a_camera_that_hardly_sees_the_table_is_not_searched(library, monkeypatch):
    world = table(library)
    truth, observation = world.truth(), world.observe()
    world.close()
    away = looks_at((0.6, 0.0, 0.5), (3.0, 0.0, 0.5))
    beside = looks_at((0.0, -0.6, 0.5), (0.4, 0.0, 0.0))
    cameras = (away, beside, observation.cameras[0], away)
    searched = []
    monkeypatch.setattr(module, "estimate_goal", lambda _models, seen, *_: searched.append(seen.cameras) or iter(()))
    shown = replace(observation, cameras=cameras, masks=None)
    for seed in range(8):
        with pytest.raises(AssertionError):  # nothing is found in no steps
            list(relocalize(models().appearance, shown, sure(truth, ("it was lost", "")), np.random.default_rng(seed)))
    assert searched == [cameras[2:3]] * 8


@pytest.mark.slow
def test_what_is_lost_is_found_anywhere_on_the_table(library):
    world = table(library)
    truth, observation = world.truth(), world.observe()
    world.close()
    position = truth.poses.position.copy()
    position[0, :2] += [0.15, -0.1] if position[0, 0] < 0 else [-0.15, 0.1]
    last = sure(replace(truth, poses=Pose(position, truth.poses.quaternion)), ("it was lost", ""))
    *before, step = relocalize(models().appearance, observation, last, np.random.default_rng(0))
    assert all(one.estimate is None for one in before)
    found = step.estimate
    assert found.trusted
    for name in (GELATIN, CAN):
        assert found.state.pose(name).position == pytest.approx(truth.pose(name).position, abs=0.005)


# Adapted models


OTHER = ImageModel(np.full(3, 0.5), 1.0, np.array([0.5, 0.6, 0.7]), "srgb")
STATE = SceneState(NAMES, Pose(np.zeros((2, 3)), np.tile([1.0, 0, 0, 0], (2, 1))), LIGHT, None)


@pytest.fixture(scope="module")
def usual():
    return AdaptedModels(models().appearance)


@pytest.fixture
def goal():
    camera = goal_camera()
    return GoalImage(camera, np.full((camera.height, camera.width, 3), 0.5, np.float32))


def test_models_for_usual_pictures_are_left_as_they_are(usual, goal):
    assert usual.to(None, NAMES) is usual
    assert usual.normalized_goal(goal) is goal


def estimated(monkeypatch, usual, scene, goal, *, trusts):
    """What is found where an estimator trusts only these models, and what it was given."""
    given = []

    def steps(models, seen, *_):
        given.append((models, seen.images[0]))
        found = sure(STATE, ("", "") if models is trusts else ("it differs", ""))
        yield EstimateStep(Progress(1, 2, "Looking"), "together", STATE)
        yield EstimateStep(Progress(2, 2, "Done"), "done", STATE, estimate=found)

    monkeypatch.setattr(module, "estimate_goal", steps)
    told = list(estimate_goal_image(usual, scene, goal, STATE, None))
    assert [step.estimate is None for step in told] == [True] * (len(told) - 1) + [False]
    return told[-1], given


def test_a_goal_image_is_taken_as_the_first_frame_was(monkeypatch, usual, goal):
    scene = usual.to(OTHER, NAMES)
    last, given = estimated(monkeypatch, usual, scene, goal, trusts=scene.models)
    assert last.image_model is OTHER
    ((_, image),) = given
    np.testing.assert_array_equal(image, scene.normalized_goal(goal).image)


def test_a_goal_image_that_the_cameras_would_not_take_is_tried_as_a_usual_one(monkeypatch, usual, goal):
    scene = usual.to(OTHER, NAMES)
    last, given = estimated(monkeypatch, usual, scene, goal, trusts=usual.models)
    assert last.image_model is None
    assert last.estimate.trusted
    np.testing.assert_array_equal(given[1][1], goal.image)


def test_a_goal_image_that_nothing_explains_stays_the_cameras_own(monkeypatch, usual, goal):
    last, _ = estimated(monkeypatch, usual, usual.to(OTHER, NAMES), goal, trusts=None)
    assert last.image_model is OTHER
    assert last.estimate.reason


def test_usual_pictures_are_looked_at_once(monkeypatch, usual, goal):
    last, given = estimated(monkeypatch, usual, usual, goal, trusts=None)
    assert (last.image_model, len(given)) == (None, 1)


# Monitor


UPRIGHT = np.array([1.0, 0, 0, 0])
MONITORED_STATE = SceneState(
    ("a", "b"),
    Pose(np.array([[0.1, 0.0, 0.02], [-0.2, 0.05, 0.03]]), np.stack([UPRIGHT, UPRIGHT])),
    Light(np.array([0.0, 0.3, 1])),
    np.array([0.15, 0.0, 0.06]),
)


def shifted_state(state: SceneState, number: int, shift) -> SceneState:
    position = state.poses.position.copy()
    position[number] += shift
    return replace(state, poses=Pose(position, state.poses.quaternion))


def test_offsets_are_on_the_table_and_turns_about_any_axis():
    there = Pose(np.array([0.1, 0.03, 0.5]), quaternion_exp(np.array([0, 0, 0.4])))
    far, turned = offsets(PoseGoal.of(MONITORED_STATE, {"a": there}), MONITORED_STATE)
    np.testing.assert_allclose(far, [0.03, 0], atol=1e-12)
    np.testing.assert_allclose(turned, [0.4, 0], atol=1e-7)


def test_what_is_turned_about_the_vertical_lies_on_the_same_side_and_what_rolled_does_not():
    turned, rolled = (
        Pose(MONITORED_STATE.pose("a").position, quaternion_exp(np.array(by))) for by in ([0, 0, 2.0], [0.4, 0, 0])
    )
    np.testing.assert_array_equal(
        lies_otherwise(PoseGoal.of(MONITORED_STATE, {"a": turned}), MONITORED_STATE), [False, False]
    )
    np.testing.assert_array_equal(
        lies_otherwise(PoseGoal.of(MONITORED_STATE, {"a": rolled}), MONITORED_STATE), [True, False]
    )


def test_patience_lasts_while_there_is_progress():
    patience = ProgressMonitor()
    assert not any(patience.is_stalled(0.5 - 0.005 * step) for step in range(60))


def test_patience_ends_after_a_while_without_and_begins_anew():
    patience = ProgressMonitor()
    told = [patience.is_stalled(0.2) for _ in range(40)]
    assert told.index(True) == 16
    assert sum(told) == 2


@pytest.mark.parametrize(("angle", "is_told"), [(0.0, False), (0.03, False), (0.2, True), (1.0, True)])
def test_a_lamp_counts_as_moved_from_a_few_degrees_on(angle, is_told):
    told = lamp_moved(Light.from_angles(0.3, 0.3), Light.from_angles(0.3, 0.3 + angle))
    assert told == (pytest.approx(angle) if is_told else None)


def test_an_object_far_from_the_pusher_was_carried():
    assert moved_by_hand(MONITORED_STATE, shifted_state(MONITORED_STATE, 1, [0.0, 0.06, 0.0])) == ("b",)
    assert moved_by_hand(MONITORED_STATE, shifted_state(MONITORED_STATE, 1, [0.0, 0.01, 0.0])) == ()


def test_what_the_pusher_can_reach_may_have_been_pushed():
    assert moved_by_hand(MONITORED_STATE, shifted_state(MONITORED_STATE, 0, [0.0, 0.06, 0.0])) == ()
