import numpy as np
import pytest

from osfcore.fields.kiloosf import FLOOR_G
from osfcore.geometry.workspace import PUSHER_ALBEDO, PUSHER_CENTRE_Z_M, PUSHER_HEIGHT_M, PUSHER_RADIUS_M
from osfcore.render.reference import pusher_field, solid_field
from osfcore.render.renderer import SceneRenderer
from osfcore.render.types import OUTPUTS, SceneBatch
from tests.core.render.scenes import corners_of, state, view


@pytest.mark.parametrize("hidden", [1, 8, 16])
def test_the_pusher_fills_its_cylinder_and_nothing_else(hidden):
    field = pusher_field(hidden)
    places, g = corners_of(field), field.rows[1:, 0]
    depth = np.minimum(PUSHER_RADIUS_M - np.hypot(*places[:, :2].T), PUSHER_HEIGHT_M / 2 - np.abs(places[:, 2]))
    assert np.all(g[depth > 1e-6] > 0)
    assert np.all(g[depth < -field.voxel] <= FLOOR_G)
    np.testing.assert_allclose(field.rows[1:, 1:4], np.broadcast_to(PUSHER_ALBEDO, (len(g), 3)), atol=1e-6)
    assert field.hidden == hidden
    assert not field.networks.any()


def test_the_pusher_looks_as_wide_and_high_as_it_is():
    camera = view((2, 0, PUSHER_CENTRE_Z_M), (0, 0, PUSHER_CENTRE_Z_M), 128, 5.0)
    scene = state({"p": (0, 0, PUSHER_CENTRE_Z_M)})
    rendered = SceneRenderer({"p": pusher_field(8)}, None).render(SceneBatch.of(scene), [camera], outputs=OUTPUTS)
    per_metre = 64 / np.tan(np.deg2rad(2.5)) / 2
    mask = rendered.masks[0, 0, 0]
    assert abs(mask.any(axis=1).sum() - PUSHER_HEIGHT_M * per_metre) < 3
    assert abs(mask.any(axis=0).sum() - 2 * PUSHER_RADIUS_M * per_metre) < 3


def test_the_shell_of_a_solid_is_closed():
    """No corner of the grid's faces is in the shell, whatever the size."""
    for half in ([0.01, 0.02, 0.03], [0.05, 0.05, 0.0501]):
        field = solid_field(lambda x, h=half: (h - np.abs(x)).min(axis=-1), lambda x: x, np.array(half), (1, 1, 1),
                            voxel=0.005, hidden=4)  # fmt: skip
        for axis in range(3):
            assert not np.moveaxis(field.index, axis, 0)[[0, -1]].any()
        assert np.all(field.extent[0] <= -np.array(half) + field.voxel)
