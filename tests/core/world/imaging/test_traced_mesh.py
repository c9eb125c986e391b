import numpy as np
import pytest

from osfcore.geometry.cameras import default_cameras
from osfcore.geometry.poses import Pose, quaternion_exp
from osfcore.world.imaging import NO_HIT, TracedMesh, into_frame
from tests.core.world.boxes import box_asset

SIZE = np.array([0.1, 0.06, 0.04])
MESH = TracedMesh(box_asset("box", tuple(SIZE)).mesh)


def slab_distance(origins: np.ndarray, directions: np.ndarray) -> np.ndarray:
    """Distance to an axis-aligned box by the slab method, the closed form."""
    with np.errstate(divide="ignore"):
        near, far = np.sort(np.stack([(-SIZE / 2 - origins) / directions, (SIZE / 2 - origins) / directions]), axis=0)
    enter, leave = near.max(axis=1), far.min(axis=1)
    return np.where((enter <= leave) & (enter > 0), enter, NO_HIT)


def test_intersections_and_occlusion_agree_with_the_slab_method():
    rng = np.random.default_rng(0)
    origins = rng.normal(size=(2000, 3))
    origins = (0.5 * origins / np.linalg.norm(origins, axis=1, keepdims=True)).astype(np.float32)
    directions = (rng.uniform(-0.06, 0.06, (2000, 3)) - origins).astype(np.float32)
    distance, faces, _ = MESH.intersect(origins, directions)
    expected = slab_distance(origins.astype(float), directions.astype(float))
    graze = np.abs(expected - distance) > 1e-4
    assert graze.mean() < 0.002
    np.testing.assert_array_equal(MESH.occludes(origins, directions)[~graze], (expected < NO_HIT)[~graze])
    assert np.all((faces >= 0) == (distance < NO_HIT))


def test_normals_face_the_ray():
    origins = np.array([[0.5, 0, 0], [0, 0, 0]], np.float32)  # from outside, and from inside the box
    directions = np.array([[-1, 0, 0], [1, 0, 0]], np.float32)
    _, faces, barycentric = MESH.intersect(origins, directions)
    normals = MESH.surface(faces, barycentric, directions).normals
    np.testing.assert_allclose(normals, [[1, 0, 0], [-1, 0, 0]], atol=1e-6)


def test_screen_box_holds_every_covered_pixel():
    rng = np.random.default_rng(1)
    camera = default_cameras(128)[0]
    for _ in range(20):
        pose = Pose(np.array([*rng.uniform(-0.3, 0.3, 2), 0.1]), quaternion_exp(rng.normal(size=3)))
        T_camera_object = camera.T_world_camera.inverse() @ pose
        box = MESH.screen_box(T_camera_object, camera.intrinsics, 128, 128)
        assert box is not None
        corners = np.stack(np.meshgrid(*MESH.bounds.T, indexing="ij"), axis=-1).reshape(-1, 3)
        pixels = np.clip(camera.project(pose.apply(corners)), 0, 128)
        assert np.all(pixels >= np.array(box[:2]) - 1e-6)
        assert np.all(pixels <= np.array(box[2:]) + 1e-6)


def test_screen_box_is_none_behind_the_camera():
    camera = default_cameras(64)[0]
    behind = camera.T_world_camera @ Pose(np.array([0, 0, -1.0]), Pose.identity().quaternion)
    assert MESH.screen_box(camera.T_world_camera.inverse() @ behind, camera.intrinsics, 64, 64) is None


def test_rays_move_into_the_object_frame():
    pose = Pose(np.array([0.1, 0.2, 0.3]), quaternion_exp(np.array([0.4, -0.2, 0.9])))
    points = np.random.default_rng(2).normal(size=(5, 3)).astype(np.float32)
    local, _ = into_frame(pose, points, points)
    np.testing.assert_allclose(local, pose.inverse().apply(points), atol=1e-6)


@pytest.mark.parametrize("footprint_m", [0.0, 0.002, 0.05, 10.0])
def test_albedo_of_one_colour_is_that_colour_at_every_level(footprint_m):
    uv = np.random.default_rng(3).uniform(size=(700, 2)).astype(np.float32)
    np.testing.assert_allclose(MESH.albedo(uv, footprint_m), 204 / 255, atol=1e-6)
