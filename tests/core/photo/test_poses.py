"""Poses of objects in photographs, and the table that they lie on."""

from dataclasses import replace

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from osfcore.errors import InvalidInput, UnknownName
from osfcore.estimation.objective import resting_orientations
from osfcore.geometry.cameras import Camera
from osfcore.geometry.poses import (
    Pose,
    quaternion_conjugate,
    quaternion_exp,
    quaternion_multiply,
    rotate,
    rotation_angle,
)
from osfcore.photo.lamp import photo_light
from osfcore.photo.photograph import Photograph, mask_box
from osfcore.photo.pose_loss import PoseLoss, TablePrior, draw, object_windows, surfels_of
from osfcore.photo.poses import (
    FINE_ACROSS,
    PhotoConfig,
    PhotoModels,
    PhotoObject,
    PhotoPose,
    align_together,
    distinct,
    doubt_of,
    estimate_photo,
    moved,
    poses_around,
    poses_from_box,
    poses_on_table,
    probabilities,
    seen_through,
    shape_symmetries,
    super_fibonacci,
    table_from_objects,
    table_from_points,
    without_others,
)
from osfcore.render.renderer import SceneRenderer
from osfcore.render.types import SceneBatch
from tests.support.errors import about
from tests.support.photographs import NAME, take

pytestmark = pytest.mark.usefixtures("one_thread")
BOTTLE = "006_mustard_bottle"
FAR, NEAR = (Pose(np.array([0.0, 0.0, depth]), quaternion_exp(np.zeros(3))) for depth in (0.9, 0.3))

# Poses and light of an object in a photograph of unknown exposure, white balance and lamp.


@pytest.fixture(scope="module")
def models(fields):
    return PhotoModels(fields)


def at(pose, name=NAME, iou=0.95):
    return PhotoObject(name, PhotoPose(pose, 0.1, iou, 1.0, 0.9, 0.8), (), "", 0.0, 0.0)


def found_in(models, photo, name, config=None):
    *_, last = estimate_photo(models, [photo], [name], np.random.default_rng(0), config)
    return last.found[0]


@pytest.mark.slow
@pytest.mark.parametrize("is_started", [False, True])
def test_poses_are_found_without_a_start_and_from_one_2_cm_and_15_degrees_off(models, taken, is_started):
    turn = quaternion_exp(np.deg2rad(15) * np.array([0.6, 0, 0.8]))
    start = Pose(taken.pose.position + [0.012, 0.0, 0.016], quaternion_multiply(turn, taken.pose.quaternion))
    found = found_in(models, taken.photo, NAME, PhotoConfig({NAME: start} if is_started else {}))
    assert np.linalg.norm(found.best.pose.position - taken.pose.position) < 8e-3
    assert np.rad2deg(rotation_angle(found.best.pose.quaternion, taken.pose.quaternion)) < 3
    assert is_started or found.doubt == ""


@pytest.mark.parametrize(("matches", "is_doubted"), [((0.8, 0.4), False), ((0.3, 0.2), True), ((0.8, 0.75), True)])
def test_of_two_orientations_that_explain_a_photo_alike_the_one_whose_print_is_found_is_trusted(
    models, taken, matches, is_doubted
):
    best, rival = (PhotoPose(taken.pose, loss, 0.95, 1.0, 0.4, m) for loss, m in zip((0.5, 0.51), matches, strict=True))
    loss = PoseLoss(object_windows([taken.photo], NAME, 60), models.surfels(NAME, FINE_ACROSS))
    assert bool(doubt_of(NAME, best, [rival], loss)) == is_doubted


def test_without_an_object_that_is_shared_cameras_stay():
    cameras = [Pose.identity(), Pose(np.ones(3), np.array([1.0, 0, 0, 0]))]
    assert align_together([], [], cameras, [], {1}) == ([], cameras)


def test_probabilities_of_orientations_follow_their_scores_and_the_print(taken):
    def those(*losses, match=0.8, iou=0.95):
        return probabilities([PhotoPose(taken.pose, loss, iou, 1.0, 0.4, match) for loss in losses])

    np.testing.assert_allclose(*those(0.5, 0.5))
    assert those(0.5, 0.5).sum() < 1
    assert those(0.5, 0.9)[0] > those(0.5, 0.6)[0] > those(0.5, 0.6, 0.6)[0]
    assert those(0.5)[0] > those(0.5, match=0.2)[0]
    assert those(0.5, match=0.3)[0] > those(0.5, match=0.3, iou=0.86)[0]


@pytest.mark.slow
def test_a_box_is_enough_and_the_mask_is_found_with_the_pose(models, taken):
    """What was proposed from the box lacks half of the object and holds as much of what is beside it."""
    whole = taken.photo.masks[NAME]
    left, top, right, bottom = mask_box(whole)
    across, down = 0.04 * (right - left), 0.04 * (bottom - top)
    box = (left - across, top - down, right + across, bottom + down)
    proposed = np.zeros_like(whole)
    proposed[int(top) : int(bottom), int(left) : int((left + right) / 2)] = True
    photo = taken.photo.with_masks({NAME: proposed}, {NAME: box})
    *_, last = estimate_photo(models, [photo], [NAME], np.random.default_rng(0))
    best, mask = last.found[0].best.pose, last.photos[0].masks[NAME]
    assert np.linalg.norm(best.position - taken.pose.position) < 0.015
    assert np.rad2deg(rotation_angle(best.quaternion, taken.pose.quaternion)) < 4
    assert (mask & whole).sum() / (mask | whole).sum() > 0.93


@pytest.mark.slow
def test_a_wrong_name_is_doubted(models, taken):
    photo = replace(taken.photo, masks={BOTTLE: taken.photo.masks[NAME]})
    assert found_in(models, photo, BOTTLE).doubt


def test_the_lamp_by_the_shading_of_a_bottle(models, fields):
    taken = take(fields, BOTTLE, light=(0.7, -0.5, -0.4))
    light = photo_light(taken.photo, [at(taken.pose, BOTTLE)], [models.surfels(BOTTLE, FINE_ACROSS)])
    assert not light.is_diffuse
    assert np.rad2deg(np.arccos(light.direction @ taken.light)) < 12


def test_objects_without_a_field_and_photos_without_a_common_object_are_refused(models, taken):
    photo = replace(taken.photo, masks={"teapot": taken.photo.masks[NAME]})
    with pytest.raises(UnknownName, check=about("teapot")):
        found_in(models, photo, "teapot")
    other = replace(taken.photo, masks={BOTTLE: taken.photo.masks[NAME]})
    for photos, what in (([taken.photo, other], "number of objects marked both in photo 1"), ([], "number of photos")):
        with pytest.raises(InvalidInput, check=about(what)):
            next(estimate_photo(models, photos, [NAME], np.random.default_rng(0)))


# Masks that lack a part of what stands in front, or hold a part of it.


@pytest.mark.slow
def test_what_is_drawn_is_added_to_the_others_and_taken_from_the_own_mask(taken, models):
    """The front's mask lacks its left part; that behind it claims the middle of it and something beside it."""
    whole, surfels = taken.photo.masks[NAME], {name: models.surfels(name, FINE_ACROSS) for name in (NAME, BOTTLE)}
    low, high = np.quantile(np.nonzero(whole)[1], (1 / 3, 2 / 3))
    x = np.arange(whole.shape[1])
    front, behind = whole & (x > low), whole & (x > low) & (x < high)
    behind[:20, :20] = True
    spoiled, found = replace(taken.photo, masks={NAME: front, BOTTLE: behind}), [at(FAR, BOTTLE, iou=0.5)]
    (seen,) = without_others([spoiled], BOTTLE, [at(taken.pose), *found], surfels)
    assert (seen.masks[NAME] & whole).sum() / (seen.masks[NAME] | whole).sum() > 0.95
    assert seen.masks[BOTTLE][:20, :20].all()
    assert seen.masks[BOTTLE].sum() < 400 + 0.05 * behind.sum()
    found = [at(taken.pose, iou=0.5), *found]  # an outline that fits badly takes nothing
    (seen,) = without_others([spoiled], BOTTLE, found, surfels)
    np.testing.assert_array_equal(seen.masks[BOTTLE], behind)
    (seen,) = without_others([spoiled], BOTTLE, [at(taken.pose), at(NEAR, BOTTLE, iou=0.5)], surfels)
    np.testing.assert_array_equal(seen.masks[BOTTLE], behind)  # nothing that is farther hides it
    assert without_others([taken.photo], BOTTLE, found, surfels) == [taken.photo]


@pytest.mark.slow
def test_an_object_behind_another_of_which_half_is_marked(models, fields, taken):
    """The box hides the bottle's lower half, but only the box's own lower half is marked: both are looked for twice."""
    front = Pose(np.array([0.01, 0.05, 0.5]), quaternion_exp(np.array([1.2, 0.9, -0.3])))
    behind = Pose(np.array([0.0, 0.02, 0.64]), quaternion_exp(np.array([-1.5, 0.3, 0.1])))
    both = Pose.stacked([front, behind])
    batch = SceneBatch((NAME, BOTTLE), both.position[None], both.quaternion[None], taken.light[None], None)
    camera = Camera("photo", Pose.identity(), taken.photo.intrinsics, 300, 260)
    drawn = SceneRenderer(fields, None).render(batch, [camera], outputs={"rgb", "masks"})
    box, bottle = drawn.masks[0, 0]
    half = box & (np.arange(260)[:, None] > np.median(np.nonzero(box)[0]))
    image = np.where((box | bottle)[..., None], drawn.rgb[0, 0], 0.2).astype(np.float32)
    exposed = np.ones(box.shape, bool)
    photo = replace(taken.photo, image=image, well_exposed=exposed, masks={NAME: half, BOTTLE: bottle})
    *_, last = estimate_photo(models, [photo], (NAME, BOTTLE), np.random.default_rng(0))
    assert last.progress.total == 2 + 2 + 1
    for found, pose in zip(last.found, (front, behind), strict=True):
        assert np.rad2deg(rotation_angle(found.best.pose.quaternion, pose.quaternion)) < 5
        assert found.probabilities[0] > 0.6


# A focal length that nobody knows


FOCAL, SIZE = 600.0, (400, 320)


def lens(focal):
    return np.array([[focal, 0, SIZE[0] / 2], [0, focal, SIZE[1] / 2], [0, 0, 1]])


def test_through_another_lens_an_object_is_seen_in_the_same_place_from_the_same_side():
    pose, half = Pose(np.array([0.2, -0.1, 0.7]), quaternion_exp(np.array([0.3, -1.0, 0.4]))), FOCAL / 2
    seen = seen_through(pose, lens(half), lens(FOCAL))
    before, after = (K @ p.position for K, p in ((lens(half), pose), (lens(FOCAL), seen)))
    np.testing.assert_allclose(after / after[2], before / before[2])
    sides = [rotate(quaternion_conjugate(p.quaternion), p.position / np.linalg.norm(p.position)) for p in (pose, seen)]
    np.testing.assert_allclose(*sides, atol=1e-12)  # the ray, in the object's frame
    back = seen_through(seen, lens(FOCAL), lens(half))
    np.testing.assert_allclose(back.matrix(), pose.matrix(), atol=1e-12)
    middle = Pose(np.array([0.0, 0.0, 0.5]), pose.quaternion)
    np.testing.assert_allclose(seen_through(middle, lens(half), lens(FOCAL)).position, [0, 0, 1])


@pytest.mark.slow
def test_two_objects_on_a_table_show_the_focal_length(models, fields, taken):
    """Assumed at half of what it is, from the poses at which such a lens shows both where they are."""
    poses = []
    for number, field in enumerate(fields.values()):
        resting = resting_orientations(field)
        turned = Pose(np.zeros(3), resting.quaternions[number])
        place = np.array([0.16 * number - 0.13, 0.1 * number - 0.05, -resting.lowest(turned)])
        poses.append(T_CAMERA_WORLD @ Pose(place, turned.quaternion))
    both = Pose.stacked(poses)
    batch = SceneBatch(tuple(fields), both.position[None], both.quaternion[None], taken.light[None], None)
    camera = Camera("photo", Pose.identity(), lens(FOCAL), *SIZE)
    drawn = SceneRenderer(fields, None).render(batch, [camera], outputs={"rgb", "masks"})
    masks = dict(zip(fields, drawn.masks[0, 0], strict=True))
    image = np.where(drawn.masks[0, 0].any(axis=0)[..., None], drawn.rgb[0, 0], 0.2).astype(np.float32)
    photo = Photograph(image, np.ones(image.shape[:2], bool), lens(FOCAL / 2), Pose.identity(), False, masks)
    starts = {name: seen_through(pose, lens(FOCAL), lens(FOCAL / 2)) for name, pose in zip(fields, poses, strict=True)}
    config = PhotoConfig(starts, focal_known=False)
    *steps, last = estimate_photo(models, [photo], tuple(fields), np.random.default_rng(0), config)
    assert any("focal length" in step.progress.note for step in steps)
    assert last.table is not None
    assert last.photos[0].intrinsics[0, 0] == pytest.approx(FOCAL, rel=0.1)
    assert last.focal_factor == pytest.approx(2, rel=0.1)
    for found, pose in zip(last.found, poses, strict=True):
        assert np.rad2deg(rotation_angle(found.best.pose.quaternion, pose.quaternion)) < 6


# Pose search


def test_super_fibonacci_rotations_are_everywhere():
    spiral = super_fibonacci(3000)
    np.testing.assert_allclose(np.linalg.norm(spiral, axis=1), 1, atol=1e-12)
    asked = Rotation.random(200, random_state=1).as_quat(scalar_first=True)
    nearest = np.array([rotation_angle(spiral, q).min() for q in asked])
    assert np.rad2deg(nearest.max()) < 20


def sides(loss, poses):
    """Left, top, right and bottom of each drawn outline."""
    shown = draw(loss.surfels, loss.windows[0], poses)[0] >= 0
    return np.array([mask_box(each) for each in shown])


def test_outlines_fill_the_box(fields, taken):
    loss = PoseLoss(object_windows([taken.photo], NAME, 44), surfels_of(fields[NAME], 0.004))
    found, box = sides(loss, poses_from_box(loss, super_fibonacci(50))), loss.windows[0].box
    centres, spans = (found[:, :2] + found[:, 2:]) / 2, found[:, 2:] - found[:, :2]
    assert np.abs(centres - (box[:2] + box[2:]) / 2).max() < 3
    assert np.all(np.abs(np.log(spans / (box[2:] - box[:2])).sum(axis=1)) < 0.2)


def test_on_a_table_outlines_are_centred_in_the_box_and_one_of_them_is_right(fields):
    """The box lies on a table 60 degrees below a camera; what rests there in the true orientation has its size, too."""
    field = fields[NAME]
    resting, T_world_camera = resting_orientations(field), T_CAMERA_WORLD.inverse()
    turned = Pose(np.zeros(3), resting.quaternions[3])
    true = Pose(np.array([0.02, 0.03, -resting.lowest(turned)]), turned.quaternion)
    seen = T_CAMERA_WORLD @ true
    batch = SceneBatch((NAME,), seen.position[None, None], seen.quaternion[None, None], np.array([[0, 0, -1.0]]), None)
    camera = Camera("photo", Pose.identity(), lens(FOCAL), *SIZE)
    drawn = SceneRenderer(fields, None).render(batch, [camera], outputs={"rgb", "masks"})
    image, mask = drawn.rgb[0, 0].astype(np.float32), drawn.masks[0, 0, 0]
    photo = Photograph(np.clip(image, 0, 1), np.ones(mask.shape, bool), lens(FOCAL), T_world_camera, True, {NAME: mask})
    loss = PoseLoss(object_windows([photo], NAME, 60), surfels_of(field, 0.004))
    poses = poses_on_table(loss, resting)
    found, box = sides(loss, poses), loss.windows[0].box
    assert np.abs((found[:, :2] + found[:, 2:] - box[:2] - box[2:]) / 2).max() < 3
    assert np.linalg.norm(poses.position[3] - true.position) < 4e-3


def test_a_box_has_three_half_turns_that_change_its_print_alone(fields):
    surfels = surfels_of(fields[NAME], 0.004)
    motions = shape_symmetries(surfels)
    np.testing.assert_allclose(motions[0].matrix(), np.eye(4), atol=1e-12)
    turns = 2 * np.arccos(np.clip(np.abs(motions.quaternion[1:, 0]), 0, 1))
    np.testing.assert_allclose(turns, np.pi, atol=np.deg2rad(6))
    axes = motions.quaternion[1:, 1:] / np.linalg.norm(motions.quaternion[1:, 1:], axis=1, keepdims=True)
    np.testing.assert_allclose(np.abs(axes @ axes.T), np.eye(3), atol=0.1)


def test_steps_are_taken_along_the_cameras_axes_around_the_given_pose(taken):
    window = object_windows([taken.photo], NAME, 44)[0]
    steps = np.array([[0.01, 0, 0, 0, 0, 0], [0, 0, 0, 0, 0.2, 0]])
    poses = moved(taken.pose, window, steps)
    around = poses_around(taken.pose, window, 20, np.random.default_rng(0))
    np.testing.assert_allclose(around.position[0], taken.pose.position, atol=1e-12)
    np.testing.assert_allclose(poses.position[0] - taken.pose.position, [0.01, 0, 0], atol=1e-12)
    np.testing.assert_allclose(poses.position[1], taken.pose.position, atol=1e-12)
    np.testing.assert_allclose(rotation_angle(poses.quaternion[1], taken.pose.quaternion), 0.2, atol=1e-12)


def test_distinct_poses_are_the_best_and_differ():
    angles = np.array([0.0, 0.05, 0.5, 1.0, 1.02])
    turns = quaternion_exp(np.stack([angles, 0 * angles, 0 * angles], axis=1))
    losses = np.array([0.3, 0.1, 0.5, 0.2, 0.4])
    assert distinct(Pose(np.zeros((5, 3)), turns), losses, 3, 10.0) == [1, 3, 2]


# The table from how objects lie on it.


T_CAMERA_WORLD = Pose(np.array([0.05, -0.02, 0.8]), quaternion_exp(np.array([2.3, 0.2, 0.1])))


def test_objects_that_stand_on_a_table_show_where_it_is_but_not_one_alone(fields):
    resting, poses = [resting_orientations(field) for field in fields.values()], []
    for number, its in enumerate(resting):
        turned = Pose(np.zeros(3), its.quaternions[number])
        place = np.array([0.1 * number, -0.05 * number, -its.lowest(turned)])
        poses.append(T_CAMERA_WORLD @ Pose(place, turned.quaternion))
    assert table_from_objects([TablePrior(resting[0])], poses[:1]) is None
    found = table_from_objects([TablePrior(its) for its in resting], poses)
    assert found.supported == (0, 1)
    table = T_CAMERA_WORLD.apply(np.random.default_rng(0).uniform(-0.2, 0.2, (20, 3)) * [1, 1, 0])
    np.testing.assert_allclose(found.T_world_camera.apply(table)[:, 2], 0, atol=3e-3)
    assert found.T_world_camera.position[2] > 0.3
    assert found.spread_deg < 2


@pytest.mark.parametrize("seed", range(3))
def test_points_on_the_table_get_height_zero_despite_outliers_and_scattered_ones_are_refused(seed):
    rng = np.random.default_rng(seed)
    T_camera_world = Pose(np.array([0.1, 0, 0.8]), quaternion_exp(np.array([2.4, 0.2 * rng.normal(), 0.1])))
    flat = np.concatenate([rng.uniform(-0.3, 0.3, (500, 2)), rng.normal(0, 1e-3, (500, 1))], axis=1)
    points = np.concatenate([T_camera_world.apply(flat), rng.uniform(-0.3, 1, (200, 3))])
    found = table_from_points(points, rng)
    assert np.abs(found.apply(points[:500])[:, 2]).max() < 6e-3
    assert found.position[2] > 0.3  # the camera is above
    with pytest.raises(InvalidInput, check=about("points on one plane")):
        table_from_points(rng.uniform(-1, 1, (500, 3)), rng)


@pytest.mark.slow
def test_two_photos_without_a_board_show_where_each_was_taken(models, fields, taken):
    """Of two objects that stand apart, from two sides, with nothing known but the masks."""
    T_table_world, poses = T_CAMERA_WORLD.inverse(), []
    for number, field in enumerate(fields.values()):
        resting = resting_orientations(field)
        turned = Pose(np.zeros(3), resting.quaternions[number])
        poses.append(Pose(np.array([0.16 * number - 0.08, 0.06 * number, -resting.lowest(turned)]), turned.quaternion))
    both = Pose.stacked(poses)
    places = (T_table_world.position, np.array([0.45, -0.3, 0.35]))
    sights = [Camera.look_at("photo", place, np.array([0.0, 0.03, 0.04])).T_world_camera for place in places]
    cameras = [Camera(f"photo{k}", sight, lens(FOCAL), *SIZE) for k, sight in enumerate(sights)]
    batch = SceneBatch(tuple(fields), both.position[None], both.quaternion[None], taken.light[None], None)
    drawn = SceneRenderer(fields, None).render(batch, cameras, outputs={"rgb", "masks"})
    photos = []
    for image, its in zip(drawn.rgb[0], drawn.masks[0], strict=True):
        image = np.where(its.any(axis=0)[..., None], image, 0.2).astype(np.float32)
        masks = dict(zip(fields, its, strict=True))
        photos.append(Photograph(image, np.ones(image.shape[:2], bool), lens(FOCAL), Pose.identity(), False, masks))
    *_, last = estimate_photo(models, photos, tuple(fields), np.random.default_rng(0))
    first, second = sights
    true, found = first.inverse() @ second, last.photos[1].T_world_camera
    assert np.linalg.norm(found.position - true.position) < 0.01
    assert np.rad2deg(rotation_angle(found.quaternion, true.quaternion)) < 1
    for each, pose in zip(last.found, poses, strict=True):
        there = first.inverse() @ pose
        assert np.linalg.norm(each.best.pose.position - there.position) < 5e-3
        assert np.rad2deg(rotation_angle(each.best.pose.quaternion, there.quaternion)) < 2
        assert each.doubt == ""
