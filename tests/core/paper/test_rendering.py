import numpy as np
import pytest
import torch

from osfcore.errors import InvalidInput, UnknownName
from osfcore.geometry.poses import quaternion_exp, quaternion_to_matrix
from osfcore.geometry.workspace import PUSHER_CENTRE_Z_M
from osfcore.paper.fields import TinyQuery
from osfcore.paper.rendering import PaperRenderer
from osfcore.render.renderer import SceneRenderer
from osfcore.render.types import Quality, SceneBatch
from tests.core.paper.scenes import VOXEL, empty_block, uniform_block
from tests.support.errors import about
from tests.support.rendered_scenes import block, camera_rays, plain_table, view

RHO = (0.8, 0.4, 0.2)
CAMERA = view((0.3, 0.1, 0.25), size=24, fov_y_deg=30)
OVERHEAD = np.array([0.0, 0.0, 1.0])
FINE = Quality(step_voxels=0.5, min_weight=0.0, stop=0.0)


def batch(positions, light=OVERHEAD, names=("a",), turn=(0, 0, 0), pusher=None) -> SceneBatch:
    positions = np.array(positions, float).reshape(1, -1, 3)
    quaternions = np.tile(quaternion_exp(np.array(turn, float)), (1, positions.shape[1], 1))
    return SceneBatch(tuple(names), positions, quaternions, light[None] / np.linalg.norm(light), pusher)


@pytest.mark.slow
def test_one_object_is_the_sum_of_equation_3():
    """Every pixel against densities and radiances asked of the networks in PyTorch."""
    field = empty_block(seed=3)
    turn, place, light = np.array([0.3, -0.5, 0.9]), np.array([0.01, -0.02, 0.0]), np.array([0.6, 0.3, 0.7])
    light /= np.linalg.norm(light)
    shown = PaperRenderer({"a": field}, None).render(batch([place], light, turn=turn), [CAMERA], quality=FINE)
    origins, directions = camera_rays(CAMERA)
    into = quaternion_to_matrix(quaternion_exp(turn)).T
    step = 0.5 * VOXEL
    t = (np.arange(int(0.6 / step)) + 0.5) * step
    local = (origins[:, None] + t[:, None] * directions[:, None] - place) @ into.T
    low, high = field.extent[0] - VOXEL, field.extent[1] + VOXEL
    inside = ((local > low) & (local < high)).all(axis=-1)
    flat = torch.as_tensor(local.reshape(-1, 3), dtype=torch.float32)
    toward = torch.as_tensor(into @ light, dtype=torch.float32).expand(len(flat), 3)
    seen = torch.as_tensor(np.repeat(directions @ into.T, len(t), axis=0), dtype=torch.float32)
    with torch.no_grad():
        scatter = TinyQuery(field)(flat, toward, seen)
    tau = scatter.sigma.numpy().reshape(inside.shape) * inside * step
    before = np.cumsum(tau, axis=1) - tau
    weights = np.exp(-before) * -np.expm1(-tau)
    expected = (weights[..., None] * scatter.direct.numpy().reshape(*inside.shape, 3)).sum(axis=1)
    assert expected.max() > 0.3
    np.testing.assert_allclose(shown.rgb[0, 0].reshape(-1, 3), expected, atol=2e-3)


def test_overlapping_objects_sum_density_and_radiance():
    """As eq. 3 says: two opaque blocks in one place shine twice as bright."""
    fields = {"a": uniform_block(RHO), "b": uniform_block(RHO)}
    renderer, lamp = PaperRenderer(fields, None), CAMERA.T_world_camera.position  # no shadows on what is seen
    one = renderer.render(batch([(0, 0, 0)], lamp), [CAMERA], outputs={"masks"})
    both = renderer.render(batch([(0, 0, 0)] * 2, lamp, names=("a", "b")), [CAMERA], outputs={"masks", "opacity"})
    inner = one.masks[0, 0, 0] & (one.rgb[0, 0, ..., 0] > 0.79)
    assert inner.sum() > 20
    np.testing.assert_allclose(one.rgb[0, 0][inner], np.tile(RHO, (inner.sum(), 1)), atol=1e-3)
    np.testing.assert_allclose(both.rgb[0, 0][inner], 2 * one.rgb[0, 0][inner], atol=2e-3)
    np.testing.assert_allclose(both.opacity[0, 0, 0][inner], 0.5, atol=1e-3)


@pytest.mark.parametrize("light", [(0.5, 0.2, 0.8), (0.0, 0.0, 1.0)])
def test_shadows_fall_where_those_of_a_solid_do(light):
    """The occupied block against a solid of our own of the same size: the table beside it differs at the rims alone."""
    table, light = plain_table(), np.array(light)
    camera = view((0.35, 0.2, 0.3), size=48, fov_y_deg=45)
    half = VOXEL * np.array([5, 4, 3])
    place = [(0.0, 0.0, half[2])]
    mine = PaperRenderer({"a": uniform_block(RHO)}, table).render(batch(place, light), [camera], outputs={"masks"})
    solid = SceneRenderer({"a": block(half)}, table).render(batch(place, light), [camera], outputs={"masks"})
    beside = ~(mine.masks | solid.masks)[0, 0, 0]
    apart = np.abs(mine.rgb - solid.rgb)[0, 0].max(axis=-1)[beside]
    assert np.mean(apart > 0.05) < 0.06
    shade = solid.rgb[0, 0][beside].max(axis=-1)
    dark = shade < np.median(shade) - 0.1
    if light[2] < 1:
        assert dark.sum() > 10
        assert np.mean(apart[dark] < 0.05) > 0.7


def test_an_object_in_a_shadow_keeps_what_the_table_keeps():
    """A small block in the shadow of one that hangs above it."""
    table = plain_table()
    fields = {"a": uniform_block(RHO), "b": uniform_block(RHO, shape=(29, 29, 9))}
    renderer = PaperRenderer(fields, table)
    camera = view((0.3, 0.0, 0.05), (0, 0, 0.02), 24, 20)
    lit = renderer.render(batch([(0, 0, 0.02)]), [camera], outputs={"masks"})
    shaded = renderer.render(batch([(0, 0, 0.02), (0, 0, 0.3)], names=("a", "b")), [camera])
    inner = lit.masks[0, 0, 0] & (lit.rgb[0, 0, ..., 0] > 0.79)
    ambient, direct = table.ambient.mean(), table.direct(OVERHEAD[None])[0].mean()
    kept = ambient / (ambient + direct)
    assert inner.sum() > 10
    np.testing.assert_allclose(shaded.rgb[0, 0][inner], kept * lit.rgb[0, 0][inner], rtol=0.02)


def test_the_pusher_is_that_of_our_renderer():
    pusher, light = np.array([[0.0, 0.0, PUSHER_CENTRE_Z_M]]), np.array([0.5, 0.4, 0.6])
    camera = view((0.3, 0.2, 0.2), (0, 0, 0.05), 32, 40)
    far = [(0.5, 0.5, 0.05)]
    mine = PaperRenderer({"a": uniform_block(RHO)}, plain_table()).render(batch(far, light, pusher=pusher), [camera])
    ours = SceneRenderer({"a": block()}, plain_table()).render(batch(far, light, pusher=pusher), [camera])
    apart = np.abs(mine.rgb - ours.rgb).max(axis=-1)
    assert np.median(apart) < 1e-3
    assert np.mean(apart > 0.1) < 0.06


def test_only_the_pixels_asked_for_are_looked_at():
    renderer = PaperRenderer({"a": uniform_block(RHO)}, plain_table())
    only = np.zeros((1, 24, 24), bool)
    only[0, 8:16] = True
    whole, part = (renderer.render(batch([(0, 0, 0.02)]), [CAMERA], only=o).rgb[0, 0] for o in (None, only))
    np.testing.assert_array_equal(part[8:16], whole[8:16])
    assert not part[:8].any()
    assert not part[16:].any()


def test_a_table_without_objects_is_that_of_our_renderer():
    empty = SceneBatch((), np.zeros((2, 0, 3)), np.zeros((2, 0, 4)), np.array([(0, 0, 1.0), (0.6, 0, 0.8)]), None)
    for fields in ({}, {"a": uniform_block(RHO)}):
        mine = PaperRenderer(fields, plain_table()).render(empty, [CAMERA], outputs={"masks", "depth"})
        ours = SceneRenderer({}, plain_table()).render(empty, [CAMERA], outputs={"masks", "depth"})
        np.testing.assert_allclose(mine.rgb, ours.rgb, atol=1e-5)
        np.testing.assert_allclose(mine.depth, ours.depth, atol=1e-5)
        assert mine.masks.shape == (2, 1, 0, 24, 24)


def test_requests_that_cannot_be_met_are_refused():
    renderer = PaperRenderer({"a": uniform_block(RHO)}, None)
    with pytest.raises(UnknownName):
        renderer.render(batch([(0, 0, 0)], names=("b",)), [CAMERA])
    with pytest.raises(InvalidInput, check=about("pixels to look at")):
        renderer.render(batch([(0, 0, 0)]), [CAMERA], only=np.ones((1, 3, 3), bool))
    widths = PaperRenderer({"a": uniform_block(RHO), "b": uniform_block(RHO, width=4)}, None)
    with pytest.raises(InvalidInput, check=about("widths")):
        widths.render(batch([(0, 0, 0)] * 2, names=("a", "b")), [CAMERA])
