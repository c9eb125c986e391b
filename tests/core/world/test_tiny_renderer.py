import numpy as np
import pytest

from osfcore.geometry.cameras import default_cameras, goal_camera
from osfcore.world.imaging import masks_of
from osfcore.world.tabletop import Tabletop


@pytest.mark.slow
def test_tiny_renderer_sees_the_same_scene_as_ray_tracing(library):
    cameras = (goal_camera(128), default_cameras(128)[1])
    exact, tiny = Tabletop(library), Tabletop(library, renderer="tiny")
    exact.arrange(1)
    tiny.load(exact.truth())
    for a, b in zip(exact.pictures(cameras), tiny.pictures(cameras), strict=True):
        mine, other = masks_of(a, 3), masks_of(b, 3)
        assert (mine & other).sum() / (mine | other).sum() > 0.85
        both = np.isfinite(a.depth) & np.isfinite(b.depth)
        assert np.median(np.abs(a.depth[both] - b.depth[both])) < 0.003
        open_table = both & ~mine.any(axis=0) & (np.abs(a.rgb - b.rgb).max(axis=-1) < 0.02)
        assert open_table.sum() > 0.5 * both.sum()  # equal shading where there is no shadow
    exact.close()
    tiny.close()
