import numpy as np
import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st

from osfcore.fields.kiloosf import EMPTY_G, FEATURES, FLOOR_G, network_size
from osfcore.fields.kiloosf_query import KiloQuery
from osfcore.fields.rays import first_shell, grid_over, refine, seen_corners, shell_field
from osfcore.fields.visual_hull import silhouette_box
from osfcore.io.image_set import read_image_set
from tests.core.fields.rendered_sets import painted_ball, write_object_set
from tests.core.render.scenes import ball, corners_of


@pytest.fixture(scope="module")
def images(tmp_path_factory):
    return read_image_set(write_object_set(tmp_path_factory.mktemp("sets") / "ball", painted_ball(), train=40), "train")


@pytest.fixture(scope="module")
def first(images):
    return first_shell(images, silhouette_box(images), across=20, cells=3, hidden=4, inside_g=6.0,
                       rng=np.random.default_rng(0))  # fmt: skip


@given(
    low=st.lists(st.floats(-2, 2), min_size=3, max_size=3),
    size=st.lists(st.floats(0.01, 3), min_size=3, max_size=3),
    across=st.integers(4, 64),
)
def test_a_grid_covers_its_box_and_one_voxel_more(low, size, across):
    box = np.array([low, np.add(low, size)])
    origin, voxel, shape = grid_over(box, across)
    far = origin + voxel * (np.array(shape) - 1)
    assert voxel == pytest.approx(max(size) / across)
    np.testing.assert_allclose((origin + far) / 2, box.mean(axis=0), atol=1e-6)
    assert np.all(origin <= box[0] - 0.99 * voxel)
    assert np.all(far >= box[1] + 0.99 * voxel)
    assert np.all(far - origin < np.array(size) + 3.01 * voxel)


def test_the_first_shell_fills_the_visual_hull(first):
    """The hull of a ball seen from all sides is about the ball."""
    radius = np.linalg.norm(corners_of(first), axis=1)
    g = first.rows[1:, 0]
    assert np.all(g[radius < 0.04] == 6.0)
    assert np.all(g[radius > 0.062] <= FLOOR_G)
    assert first.networks.shape == (27, network_size(4))
    assert first.cells.shape == (3, 3, 3)
    np.testing.assert_array_equal(first.rows[0], [EMPTY_G, *[0] * 7])
    # Dipoles point outward.
    rim = (radius > 0.042) & (radius < 0.055)
    outward = corners_of(first)[rim] / radius[rim, None]
    ours = first.rows[1:, 4:7][rim]
    assert np.mean(np.sum(outward * ours, axis=1)) > 0.9 * 0.75


def test_cells_begin_in_agreement(first):
    assert np.ptp(first.networks, axis=0).max() == 0
    assert np.ptp(first.networks) > 0


def test_refining_changes_the_grid_but_not_the_field(first, images):
    fine = refine(first, images, across=40, rng=np.random.default_rng(0))
    assert fine.voxel == pytest.approx(np.ptp(first.extent, axis=0).max() / 40, rel=1e-5)
    # Only what is seen is kept: the inside of a solid is not.
    radius = np.linalg.norm(corners_of(fine), axis=1)
    assert radius.min() > 0.02
    surface = np.random.default_rng(0).normal(size=(200, 3))
    surface *= np.random.default_rng(1).uniform(0.046, 0.052, (200, 1)) / np.linalg.norm(surface, axis=1, keepdims=True)
    x = torch.tensor(surface, dtype=torch.float32)
    light, look = torch.nn.functional.normalize(x, dim=1), -torch.nn.functional.normalize(x, dim=1)
    before, after = (KiloQuery(f)(x, light, look) for f in (first, fine))
    np.testing.assert_allclose(after.ambient.detach(), before.ambient.detach(), atol=0.02)
    np.testing.assert_allclose(after.direct.detach(), before.direct.detach(), atol=0.1)
    g_before, g_after = (KiloQuery(f).features(x)[:, 0].detach().numpy() for f in (first, fine))
    assert np.mean(np.abs(g_before - g_after) < 1.0) > 0.9


def test_only_corners_near_a_surface_are_seen(images):
    field = ball(0.05, voxel=0.005)
    seen = seen_corners(field, images, np.random.default_rng(0))
    places = field.origin + field.voxel * np.argwhere(seen)
    radius = np.linalg.norm(places, axis=1)
    assert len(places) > 200
    assert np.all(np.abs(radius - 0.05) < 3 * field.voxel)


def test_a_shell_is_stored_row_by_row_and_never_touches_the_faces():
    rng = np.random.default_rng(0)
    shape = (5, 6, 7)
    features = rng.normal(size=(*shape, FEATURES)).astype(np.float32)
    keep = rng.random(shape) < 0.6
    before = keep.copy()
    networks = np.zeros((1, network_size(5)), np.float32)
    field = shell_field(np.zeros(3), 0.1, features, keep, np.zeros((1, 1, 1), np.int32), networks, np.zeros(3))
    np.testing.assert_array_equal(keep, before)  # the caller's array stays
    assert field.hidden == 5
    inner = np.zeros(shape, bool)
    inner[1:-1, 1:-1, 1:-1] = keep[1:-1, 1:-1, 1:-1]
    np.testing.assert_array_equal(field.index > 0, inner)
    np.testing.assert_array_equal(field.rows[field.index[inner]], features[inner])
    assert np.all(field.density[~inner] == EMPTY_G)
