import shutil

import pytest

from app.cli.collect import CollectObjectCommand, CollectObservationCommand, CollectPushesCommand, CollectTableCommand
from osfcore.errors import InvalidInput, UnknownName
from osfcore.inspection.check import check_path
from osfcore.io.push_file import read_pushes
from osfcore.world.collect_pushes import CollectPushes
from tests.support.errors import about


def test_object_images(data_dir, tmp_path):
    out = tmp_path / "set"
    result = CollectObjectCommand("009_gelatin_box", out, images=60, size=32, data_dir=data_dir).run()
    assert result == {"out": str(out), "images": 60}
    assert check_path(out).facts == {"train": 20, "test": 40}


def test_table_images(tmp_path):
    out = tmp_path / "table"
    assert CollectTableCommand(out, images=60, size=16).run()["images"] == 60
    assert check_path(out).kind == "image set"


def test_pushes_tell_their_shares(data_dir, tmp_path):
    out = tmp_path / "pushes.h5"
    command = CollectPushesCommand(out, episodes=3, steps=10, policy="directed", workers=1, data_dir=data_dir)
    result = command.run()
    assert check_path(out).facts == {"episodes": 3, "steps": 30}
    assert 0 <= result["contact_share"] <= 1
    assert 0 <= result["motion_share"] <= 1
    assert result["episodes_per_s"] > 0


def test_frames_of_the_goal_camera_go_along_with_pushes(data_dir, tmp_path):
    out = tmp_path / "pushes.h5"
    frames = {"images": True, "camera": "goal", "size": 16, "random_lights": True}
    CollectPushesCommand(out, episodes=1, steps=2, workers=1, data_dir=data_dir, **frames).run()
    (episode,) = read_pushes(out)
    assert episode.frames is not None
    assert episode.frames.shape == (3, 16, 16, 3)


def test_mistakes_are_errors_of_ours(data_dir, tmp_path):
    with pytest.raises(UnknownName):
        CollectObjectCommand("teapot", tmp_path / "set", data_dir=data_dir).run()
    with pytest.raises(InvalidInput, check=about("workers")):
        CollectPushesCommand(CollectPushes(tmp_path / "a.h5"), workers=0, data_dir=data_dir).run()


@pytest.mark.slow
def test_an_observation_is_of_objects_with_fields(data_dir, tmp_path, capsys):
    shutil.copytree(data_dir / "objects" / "009_gelatin_box", data_dir / "objects" / "box_without_field")
    for seed in range(4):
        out = tmp_path / str(seed)
        result = CollectObservationCommand(out, objects=2, seed=seed, size=16, data_dir=data_dir).run()
        assert result["cameras"] == ["0", "1", "2", "3"]
        assert "box_without_field" not in result["objects"]
        assert f"4 views of {', '.join(result['objects'])}." in capsys.readouterr().out
        assert check_path(out).kind == "observation"
        assert check_path(out / "truth.json").kind == "scene"
    names = ("009_gelatin_box",)
    goal = CollectObservationCommand(tmp_path / "goal", names, goal=True, json=True, data_dir=data_dir).run()
    assert goal == {"out": str(tmp_path / "goal"), "objects": list(names), "cameras": ["goal"]}
    assert capsys.readouterr().out == ""
