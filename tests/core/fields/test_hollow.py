import numpy as np
import pytest

from osfcore.fields.hollow import fit_voxels, open_hollows, surface_misfit, without_fog
from osfcore.fields.kiloosf import FLOOR_G, KiloOSF
from osfcore.fields.rays import first_shell
from osfcore.fields.visual_hull import silhouette_box
from osfcore.geometry.cameras import Camera
from osfcore.io.image_set import ImageSet
from osfcore.objects.asset import TexturedMesh
from osfcore.world.imaging import RayTracer, TracedMesh
from tests.support.rendered_sets import directions

HALF, DEEP, THIN = 0.05, 0.03, 0.006  # half the width, half the height and the walls of the cup


def mesh_of(*slabs: tuple[tuple[float, float, float], tuple[float, float, float]]) -> TexturedMesh:
    """Boxes given by their least and greatest corners, all of one plain colour."""
    vertices, normals = [], []
    for low, high in np.array(slabs):
        for axis in range(3):
            for side in (0, 1):
                normal = np.eye(3)[axis] * (2 * side - 1)
                u, v = np.eye(3)[(axis + 1) % 3], np.eye(3)[(axis + 2) % 3]
                corners = [a * u + b * v + side * np.eye(3)[axis] for a, b in ((0, 0), (1, 0), (1, 1), (0, 1))]
                vertices += [low + (high - low) * c for c in (corners if side else corners[::-1])]
                normals += [normal] * 4
    first = 4 * np.arange(len(vertices) // 4)[:, None]
    faces = np.concatenate([first + [0, 1, 2], first + [0, 2, 3]]).astype(np.int32)
    texture = np.full((4, 4, 3), (200, 120, 80), np.uint8)
    return TexturedMesh(np.array(vertices), np.array(normals), faces, np.full((len(vertices), 2), 0.5), texture)


def images_of(mesh: TexturedMesh, lowest: float, *, size: int = 64) -> ImageSet:
    """Views from directions with z >= lowest under lights from above."""
    tracer, rng = RayTracer({"it": TracedMesh(mesh)}), np.random.default_rng(0)
    places, lights = directions(rng, 150, lowest), directions(rng, 150, 0.2)
    cameras = tuple(Camera.look_at("view", 0.25 * place, (0, 0, 0), size=size, fov_y_deg=40) for place in places)
    rgba = np.zeros((len(cameras), size, size, 4), np.float32)
    for image, camera, light in zip(rgba, cameras, lights, strict=True):
        picture = tracer.render_alone("it", light, camera, samples=2)
        image[..., 3] = picture.coverage[0]
        image[..., :3] = picture.rgb / np.maximum(picture.coverage[0, ..., None], 1e-3)
    return ImageSet(cameras, lights, np.round(255 * np.clip(rgba, 0, 1)).astype(np.uint8))


def hull_of(images: ImageSet) -> KiloOSF:
    return first_shell(images, silhouette_box(images), across=32, cells=1, hidden=1, inside_g=6.0,
                       rng=np.random.default_rng(0))  # fmt: skip


def density_at(field: KiloOSF, points) -> np.ndarray:
    places = np.round((np.asarray(points) - field.origin) / field.voxel).astype(int)
    return field.density[tuple(places.T)]


INSIDE = [(x, y, z) for x in (-0.02, 0, 0.02) for y in (-0.02, 0, 0.02) for z in (0, 0.015, 0.027)]
WALLS = [(s * (HALF - 0.003), y, z) for s in (-1, 1) for y in (-0.02, 0, 0.02) for z in (-0.02, 0, 0.015)]
FLOOR = [(x, y, 0.003 - DEEP) for x in (-0.02, 0, 0.02) for y in (-0.02, 0, 0.02)]


@pytest.mark.slow
def test_a_square_cup_that_is_open_at_the_top_is_opened_and_its_walls_stay():
    outer, inner = HALF, HALF - THIN
    floor = ((-outer, -outer, -DEEP), (outer, outer, THIN - DEEP))
    walls = (
        ((-outer, -outer, -DEEP), (-inner, outer, DEEP)),
        ((inner, -outer, -DEEP), (outer, outer, DEEP)),
        ((-outer, -outer, -DEEP), (outer, -inner, DEEP)),
        ((-outer, inner, -DEEP), (outer, outer, DEEP)),
    )
    images = images_of(mesh_of(floor, *walls), -0.5)
    hull = hull_of(images)
    assert np.all(density_at(hull, INSIDE) > 0)
    opened = open_hollows(hull, images, fog_g=-5.5)
    assert np.all(density_at(opened, INSIDE) <= -5.5)
    assert np.all(density_at(opened, WALLS) > 0)
    assert np.all(density_at(opened, FLOOR) > 0)
    fitted = without_fog(fit_voxels(opened, images, steps=120, rays=512, rng=np.random.default_rng(0)))
    assert np.all(density_at(fitted, INSIDE) <= FLOOR_G)
    assert np.all(density_at(fitted, WALLS) > 0)
    # A lid fits worse than a wall, however bright the images.
    misfit = surface_misfit(hull, images, hull.density > 0)
    darker = ImageSet(images.cameras, images.light_directions, images.rgba // np.array([2, 2, 2, 1], np.uint8))
    np.testing.assert_allclose(surface_misfit(hull, darker, hull.density > 0), misfit, atol=0.05)
    points = hull.origin + hull.voxel * np.moveaxis(np.indices(hull.index.shape), 0, -1)
    is_middle = (np.abs(points[..., :2]) < 0.03).all(axis=-1)
    lid, floor = (misfit[is_middle & (side * points[..., 2] > 0.02)] for side in (1, -1))
    assert np.nanmedian(lid) > 2 * np.nanmedian(floor)
    assert np.nanmin(misfit) >= 0
    assert np.nanmax(misfit) <= 1


def test_a_box_keeps_all_its_faces_and_descent_lessens_what_its_colours_miss():
    images = images_of(mesh_of(((-HALF, -HALF, -DEEP), (HALF, HALF, DEEP))), -1.0)
    hull = hull_of(images)
    opened = open_hollows(hull, images, fog_g=-5.5)
    grid = np.linspace(-0.03, 0.03, 5)
    for z in (0.003 - DEEP, DEEP - 0.003):
        assert np.all(density_at(opened, [(x, y, z) for x in grid for y in grid]) > 0)
    fitted = fit_voxels(hull, images, steps=100, rays=512, rng=np.random.default_rng(0))
    colours = fitted.rows[fitted.index[fitted.density > 0], 1:4]
    wanted = np.array([200, 120, 80]) / 255
    shares = colours / np.maximum(colours.sum(axis=1, keepdims=True), 1e-6)
    seen = np.abs(shares - wanted / wanted.sum()).max(axis=1) < 0.05
    assert seen.mean() > 0.2  # the surface; nothing is learned inside
