import json
from pathlib import Path

import pytest

from osfcore.errors import CannotWrite, InvalidInput
from osfcore.io.output_paths import check_place, check_weights_place

KEYS = ("psnr_full", "psnr_mask")


def test_places_that_can_be_written_are_left_as_they_were(tmp_path, monkeypatch):
    check_place(tmp_path / "deep" / "down" / "a.png")
    monkeypatch.chdir(tmp_path)
    for path in (tmp_path / "a.safetensors", Path("a.safetensors")):
        check_weights_place(path, KEYS)
    assert list(tmp_path.iterdir()) == []
    (tmp_path / "a.json").write_text(json.dumps({"psnr_full": 30, "psnr_mask": 25, "bytes": 1}))
    check_weights_place(tmp_path / "a.safetensors", KEYS)  # metrics of an older training may be replaced


@pytest.mark.parametrize(
    "name", ["folder", "file/a.png", "x" * 250 + ".png", "y" * 300 + "/a.png", "/".join(["z" * 200] * 30), "\ud800.png"]
)
def test_places_that_cannot_be_written_are_refused(tmp_path, name):
    (tmp_path / "folder").mkdir()
    (tmp_path / "file").write_text("mine")
    for path in (tmp_path / name, Path("/proc/a.png")):
        with pytest.raises(CannotWrite):
            check_place(path)
    with pytest.raises(InvalidInput):
        check_weights_place(tmp_path / "a.pt", KEYS)
    assert sorted(path.name for path in tmp_path.iterdir()) == ["file", "folder"]


@pytest.mark.parametrize("text", ["", "[]", '{"psnr_full": 30}', '{"people": []}', "\xff", '{"a":' * 5000])
def test_a_file_of_somebody_else_is_not_written_over(tmp_path, text):
    (tmp_path / "a.json").write_text(text, encoding="latin-1")
    (tmp_path / "b.json").mkdir()
    (tmp_path / "c.json").symlink_to(tmp_path / "nowhere")
    for name in "abc":
        with pytest.raises(InvalidInput):
            check_weights_place(tmp_path / f"{name}.safetensors", KEYS)
    assert (tmp_path / "a.json").read_text(encoding="latin-1") == text
