import io

import numpy as np
import pytest
import trimesh

from osfcore.objects.asset import TexturedMesh, viewer_glb


@pytest.mark.parametrize("side", [32, 1500])
def test_glb_holds_the_same_surface_with_a_small_texture(side):
    ball = trimesh.creation.icosphere(2, 0.05)
    texture = np.broadcast_to(np.array([200, 100, 50], np.uint8), (side, side // 2, 3)).copy()
    uv = np.random.default_rng(0).random((len(ball.vertices), 2)).astype(np.float32)
    vertices = np.array(ball.vertices, np.float32)
    mesh = TexturedMesh(vertices, vertices / 0.05, np.array(ball.faces, np.int32), uv, texture)
    glb = viewer_glb(mesh)
    assert b"image/jpeg" in glb
    scene = trimesh.load_scene(io.BytesIO(glb), file_type="glb", process=False)
    (back,) = scene.dump()
    np.testing.assert_allclose(back.vertices, vertices, atol=1e-6)
    np.testing.assert_allclose(back.visual.uv, uv, atol=1e-5)
    image = back.visual.material.baseColorTexture
    assert max(image.size) == min(side, 1024)
    assert image.height == 2 * image.width
    assert np.abs(np.asarray(image).astype(int) - (200, 100, 50)).max() < 6
