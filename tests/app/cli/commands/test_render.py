import json

import numpy as np
import pytest
from PIL import Image

from app.cli.commands.render import Render
from osfcore.errors import CannotWrite, CorruptFile, InvalidInput, UnknownName
from osfcore.geometry.cameras import default_cameras
from osfcore.geometry.light import Light
from osfcore.geometry.poses import Pose
from osfcore.geometry.states import SceneState
from osfcore.io.scene_file import Scene, scene_to_json
from tests.support.errors import about

MUSTARD = "006_mustard_bottle"


@pytest.fixture
def scene_file(tmp_path):
    def write(*names: str):
        poses = Pose(np.tile([0.0, 0, 0.096], (len(names), 1)), np.tile([1.0, 0, 0, 0], (len(names), 1)))
        scene = Scene(SceneState(names, poses, Light(np.array([0.5, 0, 1.0])), None), default_cameras(64))
        path = tmp_path / "scene.json"
        path.write_text(json.dumps(scene_to_json(scene)))
        return path

    return write


def test_a_shipped_object_is_rendered_on_the_table(scene_file, tmp_path):
    out = tmp_path / "image.png"
    result = Render(scene_file(MUSTARD), out, data_dir=tmp_path).run()
    assert (result["width"], result["height"]) == (64, 64)
    pixels = np.asarray(Image.open(out)).astype(int)
    yellow = (pixels[..., 0] - pixels[..., 2] > 60).sum()
    assert 40 < yellow < 800  # a yellow bottle of about 9 x 17 px among grey wood


@pytest.mark.parametrize("camera", ["0", "goal"])
def test_a_scene_without_cameras_is_seen_by_the_usual_ones(scene_file, tmp_path, camera):
    path = scene_file(MUSTARD)
    content = json.loads(path.read_text())
    del content["cameras"]
    path.write_text(json.dumps({**content, "trusted": True}))
    result = Render(path, tmp_path / "image.png", camera=camera, data_dir=tmp_path).run()
    assert (result["width"], result["height"]) == (128, 128)


def test_mistakes_are_told_in_words(scene_file, tmp_path):
    out = tmp_path / "image.png"
    with pytest.raises(InvalidInput, check=about("camera")):
        Render(scene_file(MUSTARD), out, camera="9", data_dir=tmp_path).run()
    with pytest.raises(InvalidInput, check=about("output file")):
        Render(scene_file(MUSTARD), tmp_path / "image.jpg", data_dir=tmp_path).run()
    with pytest.raises(UnknownName, check=about("spoon")):
        Render(scene_file("spoon"), out, data_dir=tmp_path).run()
    with pytest.raises(CorruptFile):
        Render(tmp_path / "nothing.json", out, data_dir=tmp_path).run()
    (tmp_path / "file").write_text("")
    with pytest.raises(CannotWrite):
        Render(scene_file(MUSTARD), tmp_path / "file" / "image.png", data_dir=tmp_path).run()


def test_a_disk_that_is_full_leaves_the_older_picture(scene_file, tmp_path, monkeypatch):
    out = tmp_path / "image.png"
    out.write_bytes(b"older")

    def full(self, data):
        with self.open("wb") as file:
            file.write(data[:100])
        raise OSError(28, "No space left on device")

    monkeypatch.setattr("pathlib.Path.write_bytes", full)
    with pytest.raises(CannotWrite):
        Render(scene_file(MUSTARD), out, data_dir=tmp_path).run()
    assert out.read_bytes() == b"older"
    assert sorted(path.name for path in tmp_path.iterdir()) == ["image.png", "scene.json"]
