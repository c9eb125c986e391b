from dataclasses import replace

import numpy as np
import pytest

from osfcore.control.world import World
from osfcore.errors import InvalidInput, MissingAssets, OsfError, OverlappingObjects, UnknownName
from osfcore.geometry.cameras import default_cameras, goal_camera
from osfcore.geometry.light import Light
from osfcore.geometry.poses import Pose
from osfcore.geometry.states import SceneState
from osfcore.geometry.workspace import PUSHER_CENTRE_Z_M
from osfcore.world.scenes import SceneRequest
from osfcore.world.tabletop import Tabletop

ACTIONS = np.column_stack([np.random.default_rng(0).uniform(-0.3, 0.3, (15, 2)), np.zeros(15)])


@pytest.fixture
def world(library):
    tabletop = Tabletop(library, cameras=default_cameras(48))
    tabletop.arrange(0)
    yield tabletop
    tabletop.close()


def same(a: SceneState, b: SceneState) -> bool:
    return a.names == b.names and all(
        np.array_equal(x, y)
        for x, y in (
            (a.poses.position, b.poses.position),
            (a.poses.quaternion, b.poses.quaternion),
            (a.light.position, b.light.position),
            (a.pusher, b.pusher),
        )
    )


def test_it_is_a_world(world):
    def drive(some: World) -> float:
        some.reset(1)
        some.act(np.array([0.1, 0, 0]))
        return some.observe().time_s

    assert drive(world) == pytest.approx(0.2)


def test_same_seed_same_bits_whatever_happened_before(library, world):
    other = Tabletop(library, cameras=default_cameras(48))
    first, second = world.reset(7), None
    for action in ACTIONS:
        world.act(action)
    other.arrange(3)
    other.act(ACTIONS[0])
    second = other.reset(7)
    np.testing.assert_array_equal(first.images, second.images)
    for action in ACTIONS:
        other.act(action)
    assert same(world.truth(), other.truth())
    np.testing.assert_array_equal(world.observe().images, other.observe().images)
    other.close()


def test_worlds_in_one_process_do_not_disturb_each_other(library, world):
    other = Tabletop(library, request=SceneRequest(count=2))
    other.arrange(5)
    before = other.truth()
    for action in ACTIONS:
        world.act(action)
    assert same(before, other.truth())
    other.close()
    world.act(ACTIONS[0])


def test_different_seeds_differ(world):
    before = world.truth()
    world.arrange(1)
    assert not same(before, world.truth())


def test_given_light_leaves_the_rest_of_the_scene_alone(library, world):
    light = Light.from_angles(0.1, 0.2)
    lit = Tabletop(library, request=SceneRequest(light=light))
    lit.arrange(0)
    np.testing.assert_array_equal(lit.truth().poses.position, world.truth().poses.position)
    np.testing.assert_array_equal(lit.truth().light.position, light.position)
    lit.close()


def test_observation_tells_neither_depth_nor_poses(world):
    observation = world.observe(masks=True)
    assert set(observation.__slots__) == {"cameras", "images", "names", "masks", "pusher", "time_s"}
    assert observation.images.shape == (4, 48, 48, 3)
    assert observation.images.dtype == np.float32
    assert observation.masks is not None
    assert observation.masks.shape == (4, 3, 48, 48)
    assert observation.masks.any(axis=(2, 3)).sum() >= 10  # of 12, most objects are seen by most cameras
    assert world.observe().masks is None


def test_steps_of_an_action_end_where_the_action_ends(library, world):
    twin = Tabletop(library)
    twin.arrange(0)
    states = list(world.act_steps(ACTIONS[0]))
    twin.act(ACTIONS[0])
    assert len(states) == 12
    assert same(states[-1], twin.truth())
    assert world.time_s == pytest.approx(0.2)
    twin.close()


@pytest.mark.parametrize("action", [[0.31, 0, 0], [0, 0, 0.1], [0, float("nan"), 0], [0, 0], "north"])
@pytest.mark.wrong_arrays
def test_bad_action_is_refused_and_nothing_moves(world, action):
    before = world.truth()
    with pytest.raises(InvalidInput):
        world.act(action)
    assert same(before, world.truth())


def test_loaded_state_is_the_truth(library, world):
    state = world.truth()
    twin = Tabletop(library)
    twin.load(state)
    loaded = twin.truth()
    np.testing.assert_allclose(loaded.poses.position, state.poses.position, atol=1e-7)
    np.testing.assert_allclose(np.abs(np.sum(loaded.poses.quaternion * state.poses.quaternion, axis=1)), 1, atol=1e-7)
    twin.close()


def test_overlapping_state_is_refused_and_the_table_stays(world):
    before = world.truth()
    positions = before.poses.position.copy()
    positions[1] = positions[0]
    with pytest.raises(OverlappingObjects):
        world.load(SceneState(before.names, Pose(positions, before.poses.quaternion), before.light, before.pusher))
    np.testing.assert_allclose(world.truth().poses.position, before.poses.position, atol=1e-7)


def test_states_off_the_table_are_refused(world):
    state = world.truth()
    below = SceneState(state.names, Pose(state.poses.position - [0, 0, 50], state.poses.quaternion), state.light, None)
    with pytest.raises(InvalidInput, match="over the table"):
        world.load(below)
    np.testing.assert_allclose(world.truth().poses.position, state.poses.position, atol=1e-7)


def test_restored_state_may_overlap_a_little(library, world):
    state = world.truth()
    sunk = state.poses.position - [0, 0, 0.004]
    pressed = SceneState(state.names, Pose(sunk, state.poses.quaternion), state.light, state.pusher)
    twin = Tabletop(library)
    with pytest.raises(OverlappingObjects):
        twin.load(pressed)
    twin.restore(pressed)
    np.testing.assert_allclose(twin.truth().poses.position, sunk, atol=1e-7)
    twin.close()


def test_objects_move_by_hand_unless_they_would_overlap(world):
    state = world.truth()
    name = state.names[0]
    away = Pose(state.poses.position[0] + [0, 0, 0.3], state.poses.quaternion[0])
    world.move_object(name, away)
    np.testing.assert_allclose(world.truth().pose(name).position, away.position, atol=1e-6)
    for step in world.settle():
        last = step
    assert last.pose(name).position[2] < 0.2
    into_table = Pose(state.poses.position[0] - [0, 0, 0.01], state.poses.quaternion[0])
    before = world.truth()
    with pytest.raises(OverlappingObjects, match="the table"):
        world.move_object(name, into_table)
    np.testing.assert_allclose(world.truth().pose(name).position, before.pose(name).position, atol=1e-6)


def test_hand_moves_are_checked(world):
    with pytest.raises(UnknownName):
        world.move_object("teapot", Pose.identity())
    with pytest.raises(InvalidInput):
        world.move_object(world.names[0], Pose(np.array([np.nan, 0, 0]), np.array([1.0, 0, 0, 0])))
    with pytest.raises(InvalidInput):
        world.move_object(world.names[0], Pose(np.array([0.0, 0, 1]), np.array([1.0, 1, 0, 0])))
    for place in ([0.61, 0, 0.1], [0, 100, 0.1], [0, 0, -50], [0, 0, -0.75], [0, 0, 1.1]):
        with pytest.raises(InvalidInput, match="over the table"):
            world.move_object(world.names[0], Pose(np.array(place), np.array([1.0, 0, 0, 0])))


def test_gaps_are_to_the_nearest_object_and_end_at_five_centimetres(library):
    boxes = ("003_cracker_box", "009_gelatin_box")
    tabletop = Tabletop(library, request=SceneRequest(names=boxes))
    tabletop.arrange(0)
    place = np.array([-0.2, 0, 0.5])
    tabletop.move_object(boxes[0], Pose(place, Pose.identity().quaternion))
    gaps = []
    for shift in (0.3, 0.1, 0.09):
        tabletop.move_object(boxes[1], Pose(place + [shift, 0, 0], Pose.identity().quaternion))
        gaps.append(tabletop.gap_m(boxes[1]))
        assert tabletop.gap_m(boxes[0]) == pytest.approx(gaps[-1], abs=1e-4)
    tabletop.close()
    assert gaps[0] == 0.05
    assert 0 < gaps[2] < gaps[1] < 0.05
    assert gaps[1] - gaps[2] == pytest.approx(0.01, abs=1e-3)
    alone = Tabletop(library, request=SceneRequest(names=boxes[:1]))
    alone.arrange(0)
    assert alone.gap_m(boxes[0]) == 0.05
    alone.close()


def test_light_changes_the_picture_and_nothing_else(world):
    before, image = world.truth(), world.observe().images
    world.set_light(Light.from_angles(1.0, 0.2))
    assert np.abs(world.observe().images - image).max() > 0.1
    np.testing.assert_array_equal(before.poses.position, world.truth().poses.position)


def test_goal_view_can_leave_the_pusher_out(world):
    world.load(replace(world.truth(), pusher=np.array([0.0, 0.3, PUSHER_CENTRE_Z_M])))
    view = (goal_camera(64),)
    with_it, without = world.render(view), world.render(view, with_pusher=False)
    assert without.pusher is None
    assert np.abs(with_it.images - without.images).max() > 0.1


@pytest.mark.parametrize("size", [16, 333, pytest.param(1024, marks=pytest.mark.slow)])
def test_any_size_up_to_1024(world, size):
    assert world.render((goal_camera(size),)).images.shape == (1, size, size, 3)


@pytest.mark.parametrize("size", [15, 1025])
def test_sizes_beyond_are_refused(size):
    with pytest.raises(InvalidInput, match="between 16 and 1024"):
        goal_camera(size)


@pytest.mark.parametrize(
    ("request_", "error"),
    [
        (SceneRequest(names=("teapot",)), UnknownName),
        (SceneRequest(names=("024_bowl",)), MissingAssets),
        (SceneRequest(names=("006_mustard_bottle",) * 2), InvalidInput),
        (SceneRequest(names=()), InvalidInput),
        (SceneRequest(count=0), InvalidInput),
        (SceneRequest(count=9), InvalidInput),
        (SceneRequest(count=6), InvalidInput),  # five were fetched
        (SceneRequest(count=2, among=("009_gelatin_box",)), InvalidInput),
        (SceneRequest(count=1, among=()), InvalidInput),
        (SceneRequest(count=1, among=("teapot",)), UnknownName),
        (SceneRequest(count=1, among=("024_bowl", "009_gelatin_box")), MissingAssets),
    ],
)
def test_bad_requests_are_refused(library, request_, error):
    with pytest.raises(error):
        Tabletop(library, request=request_)


def test_random_scenes_choose_among_what_is_named(library):
    among = ("003_cracker_box", "009_gelatin_box", "035_power_drill")
    world, seen = Tabletop(library, request=SceneRequest(count=1, among=among)), set()
    for seed in range(12):
        world.arrange(seed)
        seen |= set(world.names)
    world.close()
    assert seen == set(among)


def test_choosing_among_everything_is_choosing_freely(library, world):
    same_choice = Tabletop(library, request=SceneRequest(among=library.names()))
    same_choice.arrange(0)
    assert same(same_choice.truth(), world.truth())
    same_choice.close()


def test_poses_within_an_action_lead_to_its_end(library, world):
    twin = Tabletop(library)
    twin.arrange(0)
    for action in ACTIONS[:3]:
        touched, poses = world.act_recorded(action, 4)
        assert touched == twin.act_contacts(action)
        assert poses.position.shape == (4, 3, 3)
        np.testing.assert_array_equal(poses.position[-1], world.truth().poses.position)
        assert same(world.truth(), twin.truth())
    with pytest.raises(InvalidInput):
        world.act_recorded(np.array([0.31, 0, 0]), 4)
    for instants in (0, -1, 5, 96):
        with pytest.raises(InvalidInput, match="divisor of 48"):
            world.act_recorded(ACTIONS[0], instants)
    assert same(world.truth(), twin.truth())
    twin.close()


def test_an_empty_table_says_so(library):
    with pytest.raises(OsfError, match="empty"):
        Tabletop(library).observe()


def test_fallen_objects_lie_on_the_floor(world):
    name, state = world.names[0], world.truth()
    pushed_off = state.poses.position + [[0.8, 0, 0.1], [0, 0, 0], [0, 0, 0]]
    world.restore(SceneState(state.names, Pose(pushed_off, state.poses.quaternion), state.light, state.pusher))
    for _ in range(15):
        world.act(np.zeros(3))
    assert -0.76 < world.truth().pose(name).position[2] < -0.5


def _episodes(library, policy_seeds: range) -> tuple[float, float, float]:
    """Fastest object [m/s], highest and lowest centre [m] over episodes of 50 random pushes."""
    tabletop = Tabletop(library)
    fastest, highest, lowest = 0.0, -np.inf, np.inf
    for seed in policy_seeds:
        tabletop.arrange(seed)
        rng = np.random.default_rng(seed)
        before = tabletop.truth().poses.position
        for _ in range(50):
            for state in tabletop.act_steps(np.array([*rng.uniform(-0.3, 0.3, 2), 0]), rate_hz=60):
                fastest = max(fastest, float(np.linalg.norm(state.poses.position - before, axis=1).max() * 60))
                before = state.poses.position
                highest, lowest = max(highest, before[:, 2].max()), min(lowest, before[:, 2].min())
    tabletop.close()
    return fastest, highest, lowest


@pytest.mark.slow
@pytest.mark.parametrize("seeds", [range(25), pytest.param(range(25, 200), marks=pytest.mark.soak)])
def test_episodes_of_random_pushes_never_explode(library, seeds):
    fastest, highest, lowest = _episodes(library, seeds)
    assert fastest < 1.5  # a bottle that topples moves at 1 m/s
    assert highest < 0.15
    assert lowest > 0.005
