import numpy as np
import pytest

from osfcore.fields.rays import RaySource, camera_rays, shares_of_views
from osfcore.io.image_set import ImageSet
from tests.core.fields.rendered_sets import directions
from tests.core.render.scenes import view


@pytest.fixture
def images():
    """Three views of different cameras and lights, with random pixels and transparent borders."""
    rng = np.random.default_rng(0)
    cameras = tuple(view(p, size=24).resized(32, 24) for p in ((0.5, 0, 0.4), (0, 0.5, 0.2), (0.1, -0.3, 0.6)))
    rgba = rng.integers(0, 256, (3, 24, 32, 4)).astype(np.uint8)
    rgba[:, :8, :, 3] = 0
    return ImageSet(cameras, directions(rng, 3), rgba)


def test_pixels_are_numbered_through_images_rows_and_columns(images):
    """A ray meets, in its camera, the centre of the pixel whose colour it carries."""
    source = RaySource(images)
    assert source.image_shape == (24, 32)
    rng = np.random.default_rng(1)
    image, row, column = rng.integers((3, 24, 32), size=(200, 3)).T
    rays = source.batch(image * 24 * 32 + row * 32 + column)
    for i in range(200):
        camera = images.cameras[image[i]]
        np.testing.assert_allclose(rays.origins[i], camera.T_world_camera.position, atol=1e-6)
        pixel = camera.project(rays.origins[i].astype(float) + 0.3 * rays.directions[i])
        np.testing.assert_allclose(pixel, (column[i] + 0.5, row[i] + 0.5), atol=1e-3)
        rgba = images.rgba[image[i], row[i], column[i]] / 255
        np.testing.assert_allclose(rays.alpha[i], rgba[3], atol=1e-6)
        np.testing.assert_allclose(rays.rgb[i], rgba[:3] * rgba[3], atol=1e-6)  # over black
        np.testing.assert_allclose(rays.lights[i], images.light_directions[image[i]], atol=1e-6)
    np.testing.assert_allclose(np.linalg.norm(rays.directions, axis=1), 1, atol=1e-6)
    assert {a.dtype for a in (rays.origins, rays.directions, rays.lights, rays.rgb, rays.alpha)} == {np.dtype("f4")}


def test_all_pixels_of_an_image(images):
    source = RaySource(images)
    rays = source.batch(source.image_pixels(2))
    np.testing.assert_allclose(rays.alpha.reshape(24, 32), images.rgba[2, ..., 3] / 255, atol=1e-6)
    origins, ways = camera_rays(images.cameras[2])
    np.testing.assert_allclose(rays.directions, ways, atol=1e-6)
    np.testing.assert_allclose(rays.origins, origins, atol=1e-6)


def test_silhouettes_are_taken_with_a_margin(images):
    images.rgba[...] = 0
    images.rgba[1, 10:12, 20, 3] = 1  # hardly visible counts too
    pixels = RaySource(images).silhouette_pixels()
    image, rest = np.divmod(pixels, 24 * 32)
    row, column = np.divmod(rest, 32)
    assert set(image) == {1}
    assert (row.min(), row.max(), column.min(), column.max()) == (7, 14, 17, 23)
    assert len(pixels) == 8 * 7


def test_the_smallest_opacity_over_views_is_found():
    cameras = [view(p, (0, 0, 0), 32, 40) for p in ((1, 0, 0), (0, 1, 0), (0, 0, 1))]
    alphas = [np.full((32, 32), value, np.float32) for value in (0.9, 0.2, 0.5)]
    alphas[1][:, 16:] = 0.8  # right half, which for a camera at +y is x < 0
    points = np.float32([[0.1, 0, 0], [-0.1, 0, 0], [5, 5, 5]])
    least, framed = shares_of_views(points, cameras, alphas, 0)
    np.testing.assert_allclose(least, [0.2, 0.5, 1.0], atol=1e-12)  # who is in no view is carved by none
    assert framed.tolist() == [True, True, False]
    forgiving, _ = shares_of_views(points, cameras, alphas, 1)
    np.testing.assert_allclose(forgiving, [0.5, 0.8, 1.0], atol=1e-12)


def test_many_points_at_once_are_as_single_ones():
    cameras = [view((1, 0.2, 0.3), (0, 0, 0), 32, 40)]
    rng = np.random.default_rng(0)
    alphas = [rng.random((32, 32), dtype=np.float32)]
    points = rng.uniform(-0.3, 0.3, (5000, 3)).astype(np.float32)
    least, _ = shares_of_views(points, cameras, alphas, 0)
    for i in range(0, 5000, 613):
        np.testing.assert_allclose(shares_of_views(points[i : i + 1], cameras, alphas, 0)[0], least[i], atol=1e-6)
