import pytest

from app.cli.main import main

NAME = "009_gelatin_box"


@pytest.fixture
def data_dir(library, tmp_path):
    (tmp_path / "data").mkdir()
    (tmp_path / "data" / "objects").symlink_to(library.root)
    return tmp_path / "data"


@pytest.mark.parametrize(
    ("arguments", "words"),
    [
        (["--tasks", "0"], "number of tasks is 0"),
        (["--names", "teapot"], "teapot"),
        (["--seed", "-1"], "seed"),
        (["--objects", "9"], "objects in a scene is 9"),
        (["--actions", "0"], "number of steps is 0"),
    ],
)
def test_a_mistake_is_one_sentence(data_dir, tmp_path, capsys, arguments, words):
    out = tmp_path / "report"
    assert main(["reproduce", "--out", str(out), "--data-dir", str(data_dir), "--only", "ladder", *arguments]) == 1
    (line,) = capsys.readouterr().err.splitlines()
    assert line.startswith("osf: ")
    assert words in line
    assert not out.exists()
