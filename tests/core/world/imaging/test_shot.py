import numpy as np
import pytest

from osfcore.geometry.cameras import Camera
from osfcore.geometry.poses import Pose
from osfcore.world.imaging import Body, Lamp, Shot, TracedMesh
from tests.core.world.boxes import box_asset

CAMERA = Camera.look_at("above", (0, 0, 1.2), (0, 0, 0), size=400)
UP, LEVEL = np.array([0, 0, 1], np.float32), np.array([1.0, 0, 0, 0])


def shot(*bodies: Body, samples: int = 3) -> Shot:
    return Shot(bodies, UP, CAMERA, Lamp(), None, samples, False)


def test_samples_fill_the_chosen_pixels_evenly():
    pixels = np.zeros((400, 400), bool)
    pixels[7, 3] = pixels[20, 30] = True
    (samples,) = shot(samples=2).sampled(pixels)
    assert samples.rows.tolist() == [7, 20]
    np.testing.assert_allclose(samples.points[:4], [[3.25, 7.25], [3.75, 7.25], [3.25, 7.75], [3.75, 7.75]], atol=1e-12)
    np.testing.assert_allclose(samples.means(samples.points), [[3.5, 7.5], [30.5, 20.5]], atol=1e-12)


def test_many_pixels_come_in_several_parts_and_none_twice():
    parts = list(shot().sampled(np.ones((400, 400), bool)))
    assert len(parts) > 1
    seen = np.concatenate([400 * part.rows + part.columns for part in parts])
    np.testing.assert_array_equal(seen, np.arange(400 * 400))


def test_directions_reach_the_depth_one():
    points = np.random.default_rng(0).uniform(0, 400, (5, 2)).astype(np.float32)
    directions = shot().directions(points)
    inverse = CAMERA.T_world_camera.inverse()
    np.testing.assert_allclose(inverse.apply(shot().origin + directions)[:, 2], 1, atol=1e-6)
    np.testing.assert_allclose(CAMERA.project(shot().origin + directions), points, atol=1e-3)


@pytest.mark.parametrize("receiver", [None, 0])
def test_light_is_stopped_by_bodies(receiver):
    box = Body(TracedMesh(box_asset("box", (0.04, 0.04, 0.04)).mesh), Pose(np.array([0.1, 0, 0.3]), LEVEL))
    points = np.array([[0.1, 0, 0], [0.1, 0, 0.33], [0.13, 0, 0]], np.float32)  # below, above, beside
    np.testing.assert_array_equal(shot(box).lit(points, receiver), [0, 1, 1])
