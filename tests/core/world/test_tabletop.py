from dataclasses import replace

import numpy as np
import pytest

from osfcore.errors import InvalidInput, MissingAssets, OsfError, OverlappingObjects, UnknownName
from osfcore.geometry.cameras import default_cameras, goal_camera
from osfcore.geometry.light import Light
from osfcore.geometry.poses import Pose
from osfcore.geometry.states import SceneState
from osfcore.geometry.workspace import PUSHER_CENTRE_Z_M
from osfcore.world.imaging import masks_of
from osfcore.world.scenes import Conditions, SceneRequest
from osfcore.world.tabletop import Tabletop
from tests.support.errors import about
from tests.support.same import assert_same

ACTIONS = np.column_stack([np.random.default_rng(0).uniform(-0.3, 0.3, (8, 2)), np.zeros(8)])
CRACKER, GELATIN, DRILL = "003_cracker_box", "009_gelatin_box", "035_power_drill"


@pytest.fixture
def world(tables):
    return tables(0)


def moved(state: SceneState, shift) -> SceneState:
    return replace(state, poses=Pose(state.poses.position + shift, state.poses.quaternion))


@pytest.mark.slow
def test_same_seed_same_bits_whatever_happened_before_and_beside_it(tables):
    world, other = tables(), tables(3)
    first = world.reset(7)
    other.act(ACTIONS[0])
    for action in ACTIONS:
        world.act(action)
    second = other.reset(7)
    np.testing.assert_array_equal(first.images, second.images)
    for action in ACTIONS:
        other.act(action)
    assert_same(world.truth(), other.truth())
    np.testing.assert_array_equal(world.observe().images, other.observe().images)
    world.arrange(8)
    assert not np.array_equal(world.truth().poses.position, other.truth().poses.position)


def test_given_light_leaves_the_rest_of_the_scene_alone(tables, world):
    light = Light.from_angles(0.1, 0.2)
    lit = tables(0, request=SceneRequest(light=light))
    np.testing.assert_array_equal(lit.truth().poses.position, world.truth().poses.position)
    np.testing.assert_array_equal(lit.truth().light.position, light.position)


def test_observation_holds_masks_on_demand_and_neither_depth_nor_poses(world):
    observation = world.observe(masks=True)
    assert set(observation.__slots__) == {"cameras", "images", "names", "masks", "pusher", "time_s", "unmasked"}
    assert observation.images.shape == (4, 48, 48, 3)
    assert observation.masks.any(axis=(2, 3)).sum() >= 10  # of 12, most objects are seen by most cameras
    assert world.observe().masks is None


def test_states_and_poses_within_an_action_lead_to_its_end(tables, world):
    twin, third = tables(0), tables(0)
    for action in ACTIONS[:3]:
        world.act(action)
        states = list(twin.act_steps(action))
        assert len(states) == 12
        _, poses = third.act_recorded(action, 4)
        assert poses.position.shape == (4, 3, 3)
        np.testing.assert_array_equal(poses.position[-1], world.truth().poses.position)
        assert_same(states[-1], world.truth())
        assert_same(third.truth(), world.truth())
    assert world.observe().time_s == pytest.approx(0.6)
    with pytest.raises(InvalidInput):
        third.act_recorded(np.array([0.31, 0, 0]), 4)
    for instants in (0, -1, 5, 96):
        with pytest.raises(InvalidInput, check=about("instants")):
            third.act_recorded(ACTIONS[0], instants)
    assert_same(third.truth(), world.truth())


@pytest.mark.wrong_arrays
def test_bad_actions_are_refused_and_nothing_moves_and_a_loaded_state_is_the_truth(tables, world):
    state, twin = world.truth(), tables()
    for action in ([0.31, 0, 0], [0, 0, 0.1], [0, float("nan"), 0], [0, 0], "north"):
        with pytest.raises(InvalidInput):
            world.act(action)
    assert_same(world.truth(), state)
    twin.load(state)
    assert_same(twin.truth(), state, atol=1e-7)


def test_overlapping_states_and_those_off_the_table_are_refused_and_it_stays(tables, world):
    before = world.truth()
    positions = before.poses.position.copy()
    positions[1] = positions[0]
    with pytest.raises(OverlappingObjects):
        world.load(replace(before, poses=Pose(positions, before.poses.quaternion)))
    with pytest.raises(InvalidInput, check=about("position")):
        world.load(moved(before, [0, 0, -50]))
    np.testing.assert_allclose(world.truth().poses.position, before.poses.position, atol=1e-7)
    sunk, empty = moved(before, [0, 0, -0.004]), tables()
    with pytest.raises(OverlappingObjects):
        empty.load(sunk)
    with pytest.raises(OsfError):
        empty.observe()  # as empty as before
    empty.restore(sunk)  # contact may leave bodies a little inside each other
    np.testing.assert_allclose(empty.truth().poses.position, sunk.poses.position, atol=1e-7)


def test_objects_move_by_hand_unless_they_would_overlap(world):
    state = world.truth()
    name = state.names[0]
    away = Pose(state.poses.position[0] + [0, 0, 0.3], state.poses.quaternion[0])
    world.move_object(name, away)
    np.testing.assert_allclose(world.truth().pose(name).position, away.position, atol=1e-6)
    *_, last = world.settle()
    assert last.pose(name).position[2] < 0.2
    before = world.truth()
    with pytest.raises(OverlappingObjects, check=about("the table")):
        world.move_object(name, Pose(state.poses.position[0] - [0, 0, 0.01], state.poses.quaternion[0]))
    np.testing.assert_allclose(world.truth().pose(name).position, before.pose(name).position, atol=1e-6)


def test_hand_moves_are_checked(world):
    level = np.array([1.0, 0, 0, 0])
    with pytest.raises(UnknownName):
        world.move_object("teapot", Pose.identity())
    with pytest.raises(InvalidInput, check=about("quaternion")):
        world.move_object(world.names[0], Pose(np.array([0.0, 0, 1]), np.array([1.0, 1, 0, 0])))
    for place in ([np.nan, 0, 0], [0.61, 0, 0.1], [0, 100, 0.1], [0, 0, -0.75], [0, 0, 1.1]):
        with pytest.raises(InvalidInput, check=about("position")):
            world.move_object(world.names[0], Pose(np.array(place), level))


def test_light_and_pusher_change_the_picture_and_nothing_else(world):
    world.load(replace(world.truth(), pusher=np.array([0.0, 0.3, PUSHER_CENTRE_Z_M])))
    before, view = world.truth(), (goal_camera(64),)
    image, without = world.render(view), world.render(view, with_pusher=False)
    assert without.pusher is None
    assert np.abs(image.images - without.images).max() > 0.1
    world.set_light(Light.from_angles(1.0, 0.2))
    assert np.abs(world.render(view).images - image.images).max() > 0.1
    np.testing.assert_array_equal(before.poses.position, world.truth().poses.position)


def test_bad_requests_are_refused(library):
    wrong = {UnknownName: [{"names": ("teapot",)}, {"count": 1, "among": ("teapot",)}]}
    wrong[MissingAssets] = [{"names": ("024_bowl",)}, {"count": 1, "among": ("024_bowl", GELATIN)}]
    wrong[InvalidInput] = [{"names": (GELATIN,) * 2}, {"names": ()}, *({"count": n} for n in (0, 6, 9))]  # of five
    wrong[InvalidInput] += [{"count": 2, "among": (GELATIN,)}, {"count": 1, "among": ()}]
    for error, requests in wrong.items():
        for given in requests:
            with pytest.raises(error):
                Tabletop(library, request=SceneRequest(**given))


def test_random_scenes_choose_among_what_is_named_and_everything_is_free_choice(tables, library, world):
    among = (CRACKER, GELATIN, DRILL)
    table, seen = tables(request=SceneRequest(count=1, among=among)), set()
    for seed in range(12):
        table.arrange(seed)
        seen |= set(table.names)
    assert seen == set(among)
    assert_same(tables(0, request=SceneRequest(among=library.names())).truth(), world.truth())


def test_fallen_objects_lie_on_the_floor(world):
    world.restore(moved(world.truth(), [[0.8, 0, 0.1], [0, 0, 0], [0, 0, 0]]))
    for _ in range(15):
        world.act(np.zeros(3))
    assert -0.76 < world.truth().poses.position[0, 2] < -0.5


@pytest.mark.slow
@pytest.mark.parametrize("seeds", [range(25), pytest.param(range(25, 200), marks=pytest.mark.soak)])
def test_episodes_of_random_pushes_never_explode(tables, seeds):
    table, fastest, heights = tables(), 0.0, []
    for seed in seeds:
        table.arrange(seed)
        rng, before = np.random.default_rng(seed), table.truth().poses.position
        for _ in range(50):
            for state in table.act_steps(np.array([*rng.uniform(-0.3, 0.3, 2), 0]), rate_hz=60):
                fastest = max(fastest, float(np.linalg.norm(state.poses.position - before, axis=1).max() * 60))
                before = state.poses.position
                heights += [before[:, 2].min(), before[:, 2].max()]
    assert fastest < 1.5  # a bottle that topples moves at 1 m/s
    assert 0.005 < min(heights) < max(heights) < 0.15


@pytest.mark.slow
def test_tiny_renderer_sees_the_same_scene_as_ray_tracing(tables):
    skewed = goal_camera(128)
    skewed = replace(skewed, intrinsics=skewed.intrinsics + [[0, 25.0, 0], [0, 0, 0], [0, 0, 0]])
    cameras = (goal_camera(128), default_cameras(128)[1], skewed)
    exact, tiny = tables(1), tables(conditions=Conditions(renderer="tiny"))
    tiny.load(exact.truth())
    for a, b in zip(exact.pictures(cameras), tiny.pictures(cameras), strict=True):
        mine, other = masks_of(a, 3), masks_of(b, 3)
        assert (mine & other).sum() / (mine | other).sum() > 0.85
        both = np.isfinite(a.depth) & np.isfinite(b.depth)
        assert np.median(np.abs(a.depth[both] - b.depth[both])) < 0.003
        open_table = both & ~mine.any(axis=0) & (np.abs(a.rgb - b.rgb).max(axis=-1) < 0.02)
        assert open_table.sum() > 0.5 * both.sum()  # equal shading where there is no shadow
