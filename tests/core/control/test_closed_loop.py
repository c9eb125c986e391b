from collections import Counter
from dataclasses import replace

import numpy as np
import pytest

from osfcore.control import closed_loop
from osfcore.control.closed_loop import (
    AdaptedModels,
    Episode,
    estimate_goal_image,
    lies_otherwise,
    moved_by_hand,
    relocalize,
)
from osfcore.control.estimators import EpisodeParts
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
from osfcore.control.prepared import PreparedLook, PreparedLooks
from osfcore.errors import InvalidInput
from osfcore.estimation.camera_response import ImageModel, srgb_of_linear
from osfcore.estimation.goal_image import GoalImageConfig
from osfcore.estimation.steps import EstimateStep
from osfcore.geometry.cameras import Camera, goal_camera
from osfcore.geometry.light import Light
from osfcore.geometry.poses import Pose, quaternion_exp
from osfcore.planning.costs import PoseGoal
from osfcore.planning.mppi import PlanSettings
from osfcore.progress import Progress
from osfcore.render.types import SceneBatch
from tests.support.errors import about
from tests.support.rendered_scenes import state
from tests.support.tabletop_scenes import CAN, GELATIN, LIGHT, NAMES, models, sure, table

DARK = ImageModel(np.full(3, 0.67), 1.0, np.ones(3), "srgb")
SMALL = EpisodeSettings(steps=12, plan=PlanSettings(samples=48, horizon=10))
KNOWN = models()


@pytest.fixture
def world(library):
    world = table(library)
    yield world
    world.close()


class Oracle:
    """Estimators that know the truth, with doubts and an image model that a test may set."""

    goal = GoalImageConfig()

    def __init__(self, world):
        self.world, self.doubts, self.image_model, self.seen = world, {}, None, []

    def found(self, look):
        state = self.world.truth()
        estimate = sure(state, self.doubts.get(look))
        yield EstimateStep(Progress(1, 1, ""), "done", state, estimate=estimate, image_model=self.image_model)

    def first_frame(self, *_):
        return self.found("first")

    def later_frame(self, _models, observation, *_):
        self.seen.append(observation)
        return self.found("next")


@pytest.fixture
def oracle(world):
    return Oracle(world)


def shifted(world, name=GELATIN, shift=(0.0, 0.0)) -> PoseGoal:
    pose = world.truth().pose(name)
    return PoseGoal.of(world.truth(), {name: Pose(pose.position + [*shift, 0.0], pose.quaternion)})


def toward_middle(world, length=0.08) -> PoseGoal:
    place = world.truth().pose(GELATIN).position[:2]
    return shifted(world, shift=-length * place / np.linalg.norm(place))


def begun(oracle, goal, settings=SMALL, world=None, **more) -> Episode:
    rng, parts = np.random.default_rng(0), EpisodeParts(estimators=oracle) if oracle else None
    return Episode(world or oracle.world, KNOWN, goal, settings, rng, parts=parts, **more)


class Changed:
    """A world whose observations are changed."""

    def __init__(self, world, change):
        self._world, self._change, self.act = world, change, world.act

    def observe(self, *, masks=False):
        return self._change(self._world.observe(masks=masks))


def dark(observation):
    """What cameras report that hand over sRGB values at two thirds of the exposure."""
    return replace(observation, images=srgb_of_linear(DARK.gain * observation.images))


def test_a_world_without_a_pusher_and_objects_of_another_scene_are_refused_before_anything_moves(world, oracle):
    before = world.truth()
    blind = Changed(world, lambda observation: replace(observation, pusher=None))
    with pytest.raises(InvalidInput, check=about("pusher")):
        list(begun(oracle, shifted(world), world=blind).run())
    with pytest.raises(InvalidInput, check=about("objects of the goal")):
        list(begun(oracle, PoseGoal(("025_mug", CAN), before.poses)).run())
    np.testing.assert_array_equal(world.truth().pusher, before.pusher)


@pytest.mark.parametrize("despite", [False, True])
def test_a_goal_image_that_is_not_explained_moves_nothing_unless_allowed(world, oracle, despite):
    now = world.truth()
    state = replace(now, poses=toward_middle(world).poses, pusher=None)
    picture = KNOWN.appearance.together.render(SceneBatch.of(state), (goal_camera(),)).rgb[0, 0]
    anything = np.full(2, np.inf)  # residuals that every picture stays below
    looks = (PreparedLook(sure(now), anything), PreparedLook(sure(state, ("it differs", "")), anything))
    settings = replace(SMALL, steps=1, despite_doubts=despite)
    goal = GoalImage(goal_camera(), picture)
    *_, last = events = list(begun(oracle, goal, settings, prepared=PreparedLooks(*looks)).run())
    assert any(isinstance(event, Noticed) and event.matter == "goal" for event in events)
    assert last.outcome == ("out of steps" if despite else "refused")
    assert any(isinstance(event, ActionExecuted) for event in events) == despite


def test_without_acting_plans_are_shown_and_nothing_moves(world, oracle):
    before, seen = world.truth(), []
    for event in begun(oracle, toward_middle(world), replace(SMALL, acting=False)).run():
        seen.append(event)
        if sum(isinstance(one, Stepped) for one in seen) == 3:
            break
    assert sum(isinstance(event, Planning) for event in seen) == 2 + 1  # rounds of two plans
    assert not any(isinstance(event, ActionExecuted) for event in seen)
    np.testing.assert_array_equal(world.truth().poses.position, before.poses.position)


def test_what_stays_doubtful_is_looked_for_once_the_pusher_made_room(world, oracle, monkeypatch):
    monkeypatch.setattr(closed_loop, "relocalize", lambda *_: oracle.found("search"))  # which takes half a minute
    seen, looks = [], []
    for event in begun(oracle, toward_middle(world), replace(SMALL, steps=6, planning=False)).run():
        oracle.doubts["next"] = ("it is hardly visible", "") if not looks.count("search") else ("", "")
        seen.append(event)
        looks += [event.look] if isinstance(event, Looking) else []
    matters = [event.matter for event in seen if isinstance(event, Noticed)]
    assert matters[:2] == ["lost", "found"]
    assert looks.count("search") == 1
    retreat = [event.action for event in seen if isinstance(event, ActionExecuted) and np.any(event.action)]
    assert len(retreat) == 2


def test_the_image_model_of_the_first_frame_holds_for_later_ones(world, oracle):
    """Later frames come at the usual exposure again, and the goal is compared with a table of the usual look."""
    oracle.image_model = DARK
    events = list(begun(oracle, toward_middle(world), replace(SMALL, steps=1), world=Changed(world, dark)).run())
    np.testing.assert_allclose(oracle.seen[-1].images, world.observe().images, atol=1e-4)
    assert [event.matter for event in events if isinstance(event, Noticed)] == ["pictures"]


@pytest.mark.slow
def test_the_table_becomes_what_was_asked_for(world, oracle):
    goal = toward_middle(world)
    events = list(begun(oracle, goal).run())
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


def test_a_goal_that_is_met_ends_at_once(world, oracle):
    *_, last = events = list(begun(oracle, shifted(world)).run())
    assert (last.outcome, last.number) == ("reached", 0)
    assert not any(isinstance(event, (Planning, ActionExecuted)) for event in events)


def test_without_planning_the_last_plan_is_followed_to_its_end(world, oracle):
    episode = begun(oracle, toward_middle(world), replace(SMALL, steps=5))
    plans, actions = [], []
    for event in episode.run():
        if isinstance(event, Planning):
            plans.append(event.round.actions)
        if isinstance(event, ActionExecuted):
            actions.append(event.action)
            episode.settings = replace(episode.settings, planning=False)
    assert len(plans) == 2
    np.testing.assert_allclose(actions, plans[-1][:5], atol=1e-12)


def test_a_plan_serves_for_as_many_actions_as_asked(world, oracle):
    events = list(begun(oracle, toward_middle(world, length=0.15), replace(SMALL, steps=5, replan_every=2)).run())
    assert sum(isinstance(event, Planning) for event in events) == 2 + 1 + 1  # rounds of three plans
    assert sum(isinstance(event, ActionExecuted) for event in events) == 5


@pytest.mark.slow
def test_nothing_coming_nearer_is_noticed(world, oracle):
    events = list(begun(oracle, toward_middle(world), replace(SMALL, steps=18, planning=False)).run())
    stalled = [event for event in events if isinstance(event, Noticed) and event.matter == "stalled"]
    assert [event.number for event in stalled] == [17]


@pytest.mark.parametrize(("renewed", "actions"), [(True, 3), (False, 2)])
def test_a_lamp_and_an_object_moved_by_hand_are_noticed_and_renew_the_number_of_steps(world, oracle, renewed, actions):
    goal, notices = toward_middle(world), []
    for event in begun(oracle, goal, replace(SMALL, steps=2, planning=False, renewed=renewed)).run():
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


def check_seen_right(last, world):
    truth = world.truth()
    assert last.estimate.trusted, last.estimate.reason
    for name in NAMES:
        assert last.estimate.state.pose(name).position == pytest.approx(truth.pose(name).position, abs=0.005)


@pytest.mark.slow
def test_by_real_eyes_later_frames_of_odd_pictures_are_right(world):
    """The cameras encode and expose otherwise, which is not announced; poses are right before and after a push."""
    episode = begun(None, toward_middle(world), replace(SMALL, steps=3), world=Changed(world, dark))
    stepped = [event for event in episode.run() if isinstance(event, Stepped)]
    assert stepped[-1].number == 3
    check_seen_right(stepped[-1], world)


@pytest.mark.slow
def test_by_real_eyes_a_lamp_and_an_object_moved_by_hand_are_survived(world):
    """The pusher stands still; somebody else moves lamp and can. Both are found again."""
    start, goal = sure(world.truth()), shifted(world, CAN, (0.0, 0.06))
    light = Light.from_angles(-1.8, 0.8)
    last = None
    for event in begun(None, goal, replace(SMALL, steps=3, planning=False), world=world, start=start).run():
        if isinstance(event, ActionExecuted) and event.number == 1:
            world.set_light(light)
        if isinstance(event, ActionExecuted) and event.number == 2:
            pose = world.truth().pose(CAN)
            world.move_object(CAN, Pose(pose.position + [0.03, 0.02, 0.0], pose.quaternion))
        last = event if isinstance(event, Stepped) else last
    check_seen_right(last, world)
    assert last.estimate.state.light.angle_to(light) < np.deg2rad(5)


def test_settings_out_of_range_are_refused():
    for wrong in ({"steps": 0}, {"steps": 10**6}, {"replan_every": 0}, {"cost": "depth"}, {"reached_rad": np.nan}):
        with pytest.raises(InvalidInput):
            EpisodeSettings(**wrong)


# Relocalization


def test_a_camera_that_hardly_sees_the_table_is_not_searched(world, monkeypatch):
    observation, last = world.observe(), sure(world.truth(), ("it was lost", ""))
    searched, step = [], EstimateStep(Progress(1, 1, ""), "done", last.state, estimate=last)
    monkeypatch.setattr(
        closed_loop, "estimate_goal", lambda _models, seen, *_: searched.append(seen.cameras) or iter([step])
    )
    away, beside = (
        Camera.look_at(name, np.array(position), np.array(target), size=64)
        for name, position, target in (("away", (0.6, 0, 0.5), (3.0, 0, 0.5)), ("beside", (0, -0.6, 0.5), (0.4, 0, 0)))
    )
    cameras = (away, beside, observation.cameras[0], away)
    shown = replace(observation, cameras=cameras, masks=None)
    for seed in range(8):
        next(relocalize(KNOWN.appearance, shown, last, np.random.default_rng(seed)))
    assert searched == [cameras[2:3]] * 8


@pytest.mark.slow
def test_what_is_lost_is_found_anywhere_on_the_table(world):
    truth, position = world.truth(), world.truth().poses.position.copy()
    position[0, :2] += [0.15, -0.1] if position[0, 0] < 0 else [-0.15, 0.1]
    last = sure(replace(truth, poses=Pose(position, truth.poses.quaternion)), ("it was lost", ""))
    *before, step = relocalize(KNOWN.appearance, world.observe(), last, np.random.default_rng(0))
    assert all(one.estimate is None for one in before)
    check_seen_right(step, world)


# Adapted models

OTHER = ImageModel(np.full(3, 0.5), 1.0, np.array([0.5, 0.6, 0.7]), "srgb")
STATE = state(dict.fromkeys(NAMES, (0, 0, 0)))


# Taken as the first frame was; as usual cameras take it; explained by nothing; usual pictures are looked at once.
@pytest.mark.parametrize(
    ("adapted", "trusts", "looks", "image_model"),
    [(True, "scene", 1, OTHER), (True, "usual", 2, None), (True, "none", 2, OTHER), (False, "none", 1, None)],
)
def test_a_goal_image_is_taken_as_the_first_frame_was_or_as_a_usual_one(
    monkeypatch, adapted, trusts, looks, image_model
):
    goal = GoalImage(goal_camera(32), np.full((32, 32, 3), 0.5, np.float32))
    usual = AdaptedModels(KNOWN.appearance)
    scene = usual.to(OTHER, NAMES) if adapted else usual
    trusted, seen = {"scene": scene.models, "usual": usual.models, "none": None}[trusts], []

    def estimate_goal(models, observation, *_):
        seen.append(observation.images[0])
        found = sure(STATE, ("", "") if models is trusted else ("it differs", ""))
        yield EstimateStep(Progress(1, 2, ""), "together", STATE)
        yield EstimateStep(Progress(2, 2, ""), "done", STATE, estimate=found)

    monkeypatch.setattr(closed_loop, "estimate_goal", estimate_goal)
    *before, last = estimate_goal_image(usual, scene, goal, STATE)
    assert all(step.estimate is None for step in before)
    assert last.image_model is image_model
    assert last.estimate.trusted == (trusts != "none")
    assert len(seen) == looks
    np.testing.assert_array_equal(seen[0], scene.normalized_goal(goal).image)
    if not adapted or looks == 2:
        np.testing.assert_array_equal(seen[-1], goal.image)


# Monitoring

WATCHED = state({"a": (0.1, 0.0, 0.02), "b": (-0.2, 0.05, 0.03)}, (0.0, 0.3, 1), (0.15, 0.0, 0.06))


@pytest.mark.parametrize(("turn", "is_other"), [([0, 0, 2.0], False), ([0.4, 0, 0], True)])
def test_what_is_turned_about_the_vertical_lies_on_the_same_side_and_what_rolled_does_not(turn, is_other):
    goal = PoseGoal.of(WATCHED, {"a": Pose(WATCHED.pose("a").position, quaternion_exp(np.array(turn)))})
    assert lies_otherwise(goal, WATCHED).tolist() == [is_other, False]


def test_an_object_that_moved_far_from_the_pusher_was_carried():
    for number, shift, names in ((1, 0.06, ("b",)), (1, 0.01, ()), (0, 0.06, ())):  # what is in reach was pushed
        position = WATCHED.poses.position.copy()
        position[number, 1] += shift
        assert moved_by_hand(WATCHED, replace(WATCHED, poses=Pose(position, WATCHED.poses.quaternion))) == names
