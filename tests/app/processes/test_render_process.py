import io
import os
import shutil

import cv2
import numpy as np
import pytest
from PIL import Image

from app.processes.messages.neural_messages import CompareView, DrawView
from app.processes.render_cameras import view_camera
from app.processes.render_process import NeuralRenderer
from osfcore.errors import CorruptFile, UnknownName
from osfcore.fields.field_library import FieldLibrary
from osfcore.geometry.cameras import Camera, goal_camera
from osfcore.geometry.light import AMBIENT, DIFFUSE, Light
from osfcore.geometry.poses import Pose
from osfcore.geometry.states import SceneState
from osfcore.metrics.image_errors import psnr
from osfcore.world.imaging import TABLE_ALBEDO
from tests.app.processes.conftest import ALBEDO, BOX, SIZE_M
from tests.app.processes.fields import write_box
from tests.support.errors import about


@pytest.fixture(scope="module")
def renderer(fields_dir):
    return NeuralRenderer(FieldLibrary(fields_dir))


def pixels(png):
    return np.asarray(Image.open(io.BytesIO(png)))


def test_a_sharp_picture_in_bands_is_the_picture_with_its_depth(renderer, state):
    eye = Camera.look_at("eye", (0.05, -0.02, 0.9), (0.05, -0.02, 0.0)).T_world_camera
    camera = view_camera(eye.position, eye.quaternion, 0.8, 1.7, 300)
    drawn = renderer.render(DrawView("a", state, camera, is_sharp=True))
    assert drawn.image.shape == (300, 510, 3)
    top = np.array(ALBEDO) * (AMBIENT + DIFFUSE * state.light.direction[2])
    np.testing.assert_allclose(drawn.image[150, 255] / 255, top, atol=0.02)
    assert drawn.depth[150, 255] == pytest.approx(0.9 - SIZE_M[2], abs=0.004)
    floor = np.array(TABLE_ALBEDO) * (AMBIENT + DIFFUSE * state.light.direction[2])
    np.testing.assert_allclose(drawn.image[5, 5] / 255, floor, atol=0.01)
    assert drawn.depth[5, 5] == pytest.approx(0.9, abs=1e-3)


def test_a_quick_picture_looks_the_same_and_has_no_depth(renderer, state):
    camera = goal_camera(96)
    quick = renderer.render(DrawView("a", state, camera, is_sharp=False))
    sharp = renderer.render(DrawView("a", state, camera, is_sharp=True))
    assert quick.depth is None
    assert psnr(quick.image / 255, sharp.image / 255) > 28


def test_a_picture_is_given_up_between_bands(renderer, state):
    asked = []

    def is_overtaken():
        asked.append(True)
        return len(asked) > 2

    camera = goal_camera(512)
    assert renderer.render(DrawView("a", state, camera, is_sharp=True), is_overtaken) is None
    assert len(asked) == 3


def test_a_comparison_measures_what_differs(renderer, state):
    camera = goal_camera(64)
    black = cv2.imencode(".png", np.zeros((64, 64, 3), np.uint8))[1].tobytes()
    png = renderer.render(CompareView("w", state, camera, black)).rendered
    truth = pixels(png)
    same = renderer.render(CompareView("x", state, camera, png))
    assert same.psnr_db > 50  # rounding to 8 bit
    assert pixels(same.difference).max() <= 4
    np.testing.assert_array_equal(pixels(same.rendered), truth)
    np.testing.assert_array_equal(pixels(same.comparison)[:, :64], truth)

    darker = (truth * 0.9).astype(np.uint8)
    other = renderer.render(CompareView("y", state, camera, cv2.imencode(".png", darker[..., ::-1])[1].tobytes()))
    wanted = -10 * np.log10(np.mean((truth / 255.0 - darker / 255.0) ** 2))
    assert other.psnr_db == pytest.approx(wanted, abs=0.2)
    three = pixels(other.comparison)
    np.testing.assert_array_equal(three[:, :64], darker)
    np.testing.assert_array_equal(three[:, 64:128], pixels(other.rendered))
    np.testing.assert_array_equal(three[:, 128:], pixels(other.difference))
    np.testing.assert_allclose(three[:, 128:], 4.0 * np.abs(truth.astype(float) - darker), atol=4)


def test_the_bare_table_can_be_drawn(renderer):
    bare = SceneState((), Pose(np.zeros((0, 3)), np.zeros((0, 4))), Light(np.array([0, 0, 1.0])), None)
    assert renderer.render(DrawView("a", bare, goal_camera(32), is_sharp=False)).image.shape == (32, 32, 3)


def test_a_field_that_was_trained_again_is_read_again(fields_dir, state, tmp_path):
    shutil.copytree(fields_dir, tmp_path, dirs_exist_ok=True)
    renderer, order = NeuralRenderer(FieldLibrary(tmp_path)), DrawView("a", state, goal_camera(64), is_sharp=False)
    before = renderer.render(order).image
    write_box(tmp_path, BOX, SIZE_M, (0.1, 0.2, 0.7))
    os.utime(tmp_path / "fields" / BOX / "field.safetensors", (0, 0))
    after = renderer.render(order).image
    assert (after[..., 2] > before[..., 2] + 50).any()


def test_missing_and_broken_fields_are_told(fields_dir, state, tmp_path):
    order = DrawView("a", state, goal_camera(32), is_sharp=False)
    shutil.copytree(fields_dir / "fields" / "table", tmp_path / "fields" / "table")
    renderer = NeuralRenderer(FieldLibrary(tmp_path, shipped=tmp_path))
    with pytest.raises(UnknownName, check=about(BOX)):
        renderer.render(order)
    (tmp_path / "fields" / BOX).mkdir()
    (tmp_path / "fields" / BOX / "field.safetensors").write_bytes(b"nonsense")
    with pytest.raises(CorruptFile):
        renderer.render(order)
