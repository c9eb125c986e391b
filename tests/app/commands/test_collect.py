import pytest

from app.commands.collect import CollectObjectCommand, CollectPushesCommand, CollectTableCommand
from osfcore.check import check_path
from osfcore.errors import InvalidInput, UnknownName


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
    result = CollectPushesCommand(out, episodes=3, steps=10, policy="directed", workers=1, data_dir=data_dir).run()
    assert check_path(out).facts == {"episodes": 3, "steps": 30}
    assert 0 <= result["contact_share"] <= 1
    assert 0 <= result["motion_share"] <= 1
    assert result["episodes_per_s"] > 0


def test_mistakes_are_errors_of_ours(data_dir, tmp_path):
    with pytest.raises(UnknownName):
        CollectObjectCommand("teapot", tmp_path / "set", data_dir=data_dir).run()
    with pytest.raises(InvalidInput, match="workers"):
        CollectPushesCommand(tmp_path / "a.h5", workers=0, data_dir=data_dir).run()
