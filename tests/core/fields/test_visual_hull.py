import dataclasses

import numpy as np
import pytest
from scipy.spatial import ConvexHull, Delaunay

from osfcore.errors import CorruptFile
from osfcore.fields.visual_hull import carve, silhouette_box
from osfcore.geometry.poses import Pose, quaternion_exp
from osfcore.io.image_set import ImageSet, read_image_set
from osfcore.world.collect_images import CollectObject, collect_object
from tests.support.ellipsoid_sets import CENTRE, HALF, turn_cameras, write_set
from tests.support.errors import about

OPENGL = np.diag([1.0, -1, -1])


@pytest.fixture(scope="module")
def many(tmp_path_factory) -> ImageSet:
    return read_image_set(write_set(tmp_path_factory.mktemp("sets") / "many", train=60, size=48), "train")


def moved(images: ImageSet, change) -> ImageSet:
    """The set with other poses of its cameras."""
    cameras = (dataclasses.replace(c, T_world_camera=change(c.T_world_camera)) for c in images.cameras)
    return ImageSet(tuple(cameras), images.light_directions, images.rgba)


def test_the_box_holds_the_object_and_little_more(many):
    box = silhouette_box(many)
    assert np.all(box[0] < CENTRE - HALF)
    assert np.all(box[1] > CENTRE + HALF)
    # Cameras look from above only, so the box may be deeper below; sideways it is off by cells and pixels.
    np.testing.assert_allclose(box[:, :2], np.stack([CENTRE - HALF, CENTRE + HALF])[:, :2], atol=0.12)
    np.testing.assert_allclose(box[:, 2], [CENTRE[2] - HALF[2], CENTRE[2] + HALF[2]], atol=0.25)


def test_every_silhouette_lies_inside_the_projected_box(many):
    box = silhouette_box(many)
    corners = np.array([[box[i, 0], box[j, 1], box[k, 2]] for i in (0, 1) for j in (0, 1) for k in (0, 1)])
    for camera, rgba in zip(many.cameras, many.rgba, strict=True):
        projected = camera.project(corners)
        outline = Delaunay(projected[ConvexHull(projected).vertices])
        rows, columns = np.nonzero(rgba[..., 3])
        assert np.all(outline.find_simplex(np.stack([columns, rows], axis=1) + 0.5) >= 0)


@pytest.mark.parametrize("scale", [1e-3, 1e3])
def test_neither_the_unit_of_length_nor_the_number_of_sets_matters(many, scale):
    scaled = moved(many, lambda pose: Pose(scale * pose.position, pose.quaternion))
    parts = [
        ImageSet(scaled.cameras[p], scaled.light_directions[p], scaled.rgba[p]) for p in (slice(9), slice(9, None))
    ]
    np.testing.assert_allclose(silhouette_box(*parts) / scale, silhouette_box(many), atol=1e-3)


def test_a_silhouette_cut_by_the_border_does_not_cut_the_object(many):
    # The right half of every second image is cropped away: those views know nothing of what lies there.
    cropped = tuple(dataclasses.replace(c, width=24) for c in many.cameras)
    halves = ImageSet(cropped, many.light_directions, np.ascontiguousarray(many.rgba[:, :, :24]))
    seen = [i for i in range(1, 60, 2) if halves.rgba[i, ..., 3].any()]
    half = ImageSet(tuple(halves.cameras[i] for i in seen), halves.light_directions[seen], halves.rgba[seen])
    box = silhouette_box(many, half)
    assert np.all(box[0] < CENTRE - HALF)
    assert np.all(box[1] > CENTRE + HALF)


@pytest.mark.parametrize(
    "turn",
    [
        lambda RT: OPENGL @ RT,
        lambda RT: np.hstack([RT[:, :3].T, -RT[:, :3].T @ RT[:, 3:]]),
        lambda RT: np.hstack([RT[:, :3].T, RT[:, 3:]]),
    ],
    ids=["OpenGL axes", "camera-to-world", "transposed"],
)
def test_wrong_camera_conventions_are_found(image_set, turn):
    turn_cameras(image_set, turn)
    images = read_image_set(image_set, "train")
    with pytest.raises(CorruptFile, check=about("OpenCV axes")):
        silhouette_box(images, where=image_set)
    hull = carve(images, resolution=8)  # there is still a box to draw
    assert hull.occupied.shape == (8, 8, 8)
    assert np.all(np.isfinite(hull.box))
    assert np.all(hull.box[1] > hull.box[0])


@pytest.mark.slow
def test_images_upside_down_are_found(library, tmp_path):
    """Far away this mirrors the object at its centre and all silhouettes agree; perspective makes the difference."""
    folder = tmp_path / "drill"
    list(collect_object(CollectObject("035_power_drill", folder, images=140, size=64), library))
    silhouette_box(read_image_set(folder, "train"), read_image_set(folder, "test"))
    turn_cameras(folder, lambda RT: np.diag([-1.0, -1, 1]) @ RT)
    with pytest.raises(CorruptFile, check=about("OpenCV axes")):
        silhouette_box(read_image_set(folder, "train"), read_image_set(folder, "test"))


def test_cameras_that_are_a_little_off_are_no_reason_to_refuse(many):
    rng = np.random.default_rng(0)
    shaken = moved(many, lambda pose: pose @ Pose(np.zeros(3), quaternion_exp(np.deg2rad(0.4) * rng.normal(size=3))))
    np.testing.assert_allclose(silhouette_box(shaken), silhouette_box(many), atol=0.1)


def test_a_single_wrong_camera_is_named(tmp_path):
    folder = write_set(tmp_path / "set", train=30, size=32)
    turn_cameras(folder, lambda RT: OPENGL @ RT, ("train",), 17)
    with pytest.raises(CorruptFile, check=about("train/r_17.png")):
        silhouette_box(read_image_set(folder, "train"))


def test_views_from_one_place_enclose_nothing(many):
    pose = many.cameras[0].T_world_camera
    same = moved(many, lambda _: pose)
    images = ImageSet(same.cameras, same.light_directions, np.repeat(many.rgba[:1], 60, axis=0))
    with pytest.raises(CorruptFile, check=about("enclose")):
        silhouette_box(images)


@pytest.mark.parametrize(("scale", "shift"), [(1e-8, 0), (1e9, 0), (1, 1e6)])
def test_an_object_that_no_file_can_hold_is_refused(many, scale, shift):
    images = moved(many, lambda pose: Pose(scale * (pose.position + [shift, 0, 0]), pose.quaternion))
    with pytest.raises(CorruptFile, check=about("coordinates")):
        silhouette_box(images)
