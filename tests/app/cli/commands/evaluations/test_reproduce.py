import json

import pytest

from app.cli.main import main

NAME = "009_gelatin_box"


@pytest.fixture
def data_dir(library, tmp_path):
    (tmp_path / "data").mkdir()
    (tmp_path / "data" / "objects").symlink_to(library.root)
    return tmp_path / "data"


@pytest.mark.slow
def test_the_smallest_report(data_dir, tmp_path, capsys):
    arguments = ["--quick", "--only", "attribution", "--tasks", "1", "--objects", "1", "--actions", "1"]
    place = ["--out", str(tmp_path / "report"), "--data-dir", str(data_dir), "--workers", "1", "--names", NAME]
    assert main(["reproduce", *arguments, *place, "--json"]) == 0
    told = capsys.readouterr()
    result = json.loads(told.out.splitlines()[-1])
    (section,) = result["sections"]
    assert [cell["label"] for cell in section["cells"]] == [
        "ours", "true light", "true poses", "true goal", "true dynamics", "all true",
    ]  # fmt: skip
    assert all(cell["figures"]["steps_median"] <= 1 for cell in section["cells"])
    assert "6 episodes" in told.err
    page = (tmp_path / "report" / "report.html").read_text()
    assert "Where episodes fail" in page
    assert "A quick look and no measurement: 1 tasks a cell, 1 actions instead of 30" in page
    assert main(["reproduce", *arguments, *place]) == 0  # everything is taken over
    assert f"The report: {tmp_path / 'report' / 'report.html'}" in capsys.readouterr().out


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
