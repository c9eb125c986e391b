import json
from importlib.resources import files
from pathlib import Path

import numpy as np
import pytest

from app.cli.commands.check import Check
from osfcore.errors import CorruptFile, InvalidInput
from osfcore.world.collect_images import CollectTable, collect_table
from tests.support.ellipsoid_sets import turn_cameras, write_set
from tests.support.errors import about


def test_a_good_set_is_described_and_drawn(tmp_path, capsys):
    out = tmp_path / "table"
    list(collect_table(CollectTable(out, images=60, size=16)))
    result = Check(out, overlay=tmp_path / "overlay.png").run()
    assert result == {"path": str(out), "kind": "image set", "train": 20, "test": 40}
    assert "good image set: 20 train and 40 test images" in capsys.readouterr().out
    assert (tmp_path / "overlay.png").stat().st_size > 1000


def test_a_bad_set_is_drawn_before_it_is_refused(tmp_path, capsys):
    folder, overlay = write_set(tmp_path / "set"), tmp_path / "overlay.png"
    turn_cameras(folder, lambda RT: np.diag([1, -1, -1]) @ RT)
    with pytest.raises(CorruptFile):
        Check(folder, overlay=overlay).run()
    assert overlay.stat().st_size > 1000
    assert "overlay.png shows how cameras" in capsys.readouterr().out
    overlay.unlink()
    (folder / "train" / "r_0.png").unlink()
    with pytest.raises(CorruptFile, check=about("r_0.png")):
        Check(folder, overlay=overlay).run()
    assert not overlay.exists()
    assert capsys.readouterr().out == ""


def test_an_overlay_of_another_kind_is_refused_for_good_and_bad_sets(tmp_path):
    good, bad = write_set(tmp_path / "good"), write_set(tmp_path / "bad")
    turn_cameras(bad, lambda RT: np.diag([1, -1, -1]) @ RT)
    for folder in (good, bad):
        with pytest.raises(InvalidInput, check=about("overlay file")):
            Check(folder, overlay=tmp_path / "o.jpg").run()


def test_with_json_nothing_else_is_printed(tmp_path, capsys):
    path = tmp_path / "scene.json"
    path.write_text(json.dumps({"objects": [], "light": {"position": [0, 0, 1]}}))
    assert Check(path, json=True).run()["objects"] == 0
    assert capsys.readouterr().out == ""


def test_what_is_not_there_is_told(tmp_path):
    with pytest.raises(CorruptFile):
        Check(tmp_path / "nothing").run()


def test_weights_are_described_and_broken_ones_refused(tmp_path):
    shipped = Path(str(files("osfcore.fields") / "shipped"))
    assert Check(shipped / "table.safetensors").run()["kind"] == "field"
    good = (shipped / "006_mustard_bottle.safetensors").read_bytes()
    whole, short, other = (tmp_path / f"{name}.safetensors" for name in ("whole", "short", "other"))
    whole.write_bytes(good)
    assert Check(whole).run()["kind"] == "field"
    short.write_bytes(good[: len(good) // 2])
    with pytest.raises(CorruptFile):
        Check(short).run()
    other.write_bytes(good.replace(b"kiloosf-1", b"kiloosf-0"))
    with pytest.raises(CorruptFile, check=about("kiloosf-0")):
        Check(other).run()
