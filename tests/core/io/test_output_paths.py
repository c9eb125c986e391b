import json
from pathlib import Path

import pytest

from osfcore.errors import CannotWrite, InvalidInput
from osfcore.io.output_paths import check_place, check_weights_place

KEYS = ("psnr_full", "psnr_mask")


def test_places_that_can_be_written_are_left_as_they_were(tmp_path):
    check_place(tmp_path / "a.png")
    check_place(tmp_path / "deep" / "down" / "a.png")
    check_weights_place(tmp_path / "a.safetensors", KEYS)
    assert list(tmp_path.iterdir()) == []


def test_a_path_within_the_working_folder_needs_no_folder(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    check_weights_place(Path("a.safetensors"), KEYS)
    assert list(tmp_path.iterdir()) == []


@pytest.mark.parametrize(
    ("name", "words"),
    [
        ("folder", "it is a folder"),
        ("file/a.png", "Not a directory"),
        ("x" * 250 + ".png", "too long"),
        ("y" * 300 + "/a.png", "too long"),
        ("/".join(["z" * 200] * 30), "too long"),
        ("\ud800.png", "cannot be written"),
    ],
)
def test_places_that_cannot_be_written_are_told(tmp_path, name, words):
    (tmp_path / "folder").mkdir()
    (tmp_path / "file").write_text("mine")
    with pytest.raises(CannotWrite, match=words):
        check_place(tmp_path / name)
    assert sorted(path.name for path in tmp_path.iterdir()) == ["file", "folder"]


def test_a_file_system_that_refuses_is_told():
    with pytest.raises(CannotWrite, match="/proc/a.png"):
        check_place(Path("/proc/a.png"))


def test_weights_have_a_suffix(tmp_path):
    with pytest.raises(InvalidInput, match=r"a.pt, but it must be a path that ends in \.safetensors"):
        check_weights_place(tmp_path / "a.pt", KEYS)


@pytest.mark.parametrize("text", ["", "[]", '{"psnr_full": 30}', '{"people": []}', "\xff", '{"a":' * 5000])
def test_a_file_of_somebody_else_is_not_written_over(tmp_path, text):
    (tmp_path / "a.json").write_text(text, encoding="latin-1")
    with pytest.raises(InvalidInput, match=r"a.json beside it is no metrics file"):
        check_weights_place(tmp_path / "a.safetensors", KEYS)
    assert (tmp_path / "a.json").read_text(encoding="latin-1") == text


def test_metrics_of_an_older_training_may_be_replaced(tmp_path):
    (tmp_path / "a.json").write_text(json.dumps({"psnr_full": 30, "psnr_mask": 25, "bytes": 1}))
    check_weights_place(tmp_path / "a.safetensors", KEYS)


def test_a_folder_or_a_broken_link_in_the_place_of_the_metrics_is_told(tmp_path):
    (tmp_path / "a.json").mkdir()
    (tmp_path / "b.json").symlink_to(tmp_path / "nowhere")
    for name in "ab":
        with pytest.raises(InvalidInput, match=f"{name}.json beside it"):
            check_weights_place(tmp_path / f"{name}.safetensors", KEYS)
