import numpy as np
import pytest

from app.processes.render_cameras import bands, scene_camera, view_camera
from osfcore.geometry.cameras import Camera

POINTS = np.array([[0.1, -0.05, 0.2], [-0.3, 0.2, 0.0], [0.0, 0.0, 0.1]])


def looking(position=(0.95, -0.95, 0.9), target=(0.0, 0.0, 0.1)):
    return Camera.look_at("eye", position, target).T_world_camera


def view(rows=480, aspect=1.7, fov=0.8, pose=None):
    pose = pose or looking()
    return view_camera(pose.position, pose.quaternion, fov, aspect, rows)


@pytest.mark.parametrize(("rows", "aspect"), [(480, 1.7), (112, 0.5), (480, 3.0), (1000, 0.1), (20, 45.0)])
def test_a_picture_stretched_over_the_view_lines_up_with_what_the_browser_draws(rows, aspect):
    """The browser puts a point at x / (z tan(fov / 2) aspect), y / (z tan(fov / 2)), from -1 to 1 over its view."""
    camera = view(rows, aspect)
    local = looking().inverse().apply(POINTS)
    half = np.tan(0.4)
    wanted = local[:, :2] / local[:, 2:] / [half * aspect, half]
    seen = camera.project(POINTS) / [camera.width / 2, camera.height / 2] - 1
    np.testing.assert_allclose(seen, wanted, atol=1e-9)
    assert camera.fov_y_rad == pytest.approx(0.8)


def test_no_side_gets_longer_than_allowed():
    assert (view(480, 1.7).height, view(480, 1.7).width) == (480, 816)
    assert (view(480, 4.0).height, view(480, 4.0).width) == (256, 1024)
    assert (view(480, 49.0).height, view(480, 49.0).width) == (21, 1024)
    assert (view(480, 0.03).height, view(480, 0.03).width) == (480, 16)


@pytest.mark.parametrize(
    "told",
    [
        {"fov": 0.0},
        {"fov": 3.2},
        {"fov": float("nan")},
        {"aspect": 0.0},
        {"aspect": float("inf")},
        {"position": [np.nan, 0, 0]},
        {"position": [1e9, 0, 0]},
        {"quaternion": [0, 0, 0, 0]},
    ],
)
def test_nonsense_from_a_browser_gives_no_camera(told):
    sane = {"position": [1, 0, 1], "quaternion": [1, 0, 0, 0], "fov": 0.8, "aspect": 1.5}
    told = {**sane, **told}
    assert view_camera(sane["position"], sane["quaternion"], sane["fov"], sane["aspect"], 100) is not None
    assert view_camera(told["position"], told["quaternion"], told["fov"], told["aspect"], 100) is None


def test_bands_are_the_picture_cut_into_strips():
    camera = view(480, 1.7)
    cut = list(bands(camera, 50_000))
    assert len(cut) == 8
    assert sum(band.height for band in cut) == camera.height
    whole, top = camera.project(POINTS), 0
    for band in cut:
        np.testing.assert_allclose(band.project(POINTS) + [0, top], whole, atol=1e-12)
        top += band.height
    assert len(list(bands(view(100, 1.0)))) == 1
    assert all(band.height >= 16 for band in bands(view(40, 20.0), 100))


def test_a_scene_has_five_cameras():
    assert scene_camera("2", 64).T_world_camera.position[0] < 0
    assert scene_camera("goal", 64).height == 64
