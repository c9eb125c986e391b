"""Each example runs as it stands, prints something, and needs the first level of the library only."""

import ast
import subprocess
import sys
from pathlib import Path

import pytest

EXAMPLES = Path(__file__).parents[1] / "examples"
WORDS = {
    "render": "one table under four lights",
    "estimate": "light: 0.",
    "predict": "past everything: 005_tomato_soup_can 0 mm",
    "plan": "after 12 actions",
}


def run(name, place, *arguments):
    program = str(EXAMPLES / f"{name}.py")
    done = subprocess.run([sys.executable, program, *arguments], cwd=place, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr[-500:]
    return done.stdout


@pytest.mark.slow
@pytest.mark.parametrize("name", WORDS)
def test_examples_that_need_no_meshes(name, tmp_path):
    assert WORDS[name] in run(name, tmp_path)
    if name == "render":
        assert (tmp_path / "relit.png").read_bytes().startswith(b"\x89PNG")


@pytest.mark.slow
@pytest.mark.parametrize("name", ["episode", "own_cost"])
def test_an_episode(name, library, tmp_path):
    printed = run(name, tmp_path, str(library.root))
    assert "ActionExecuted" in printed
    assert "Finished" in printed


def test_examples_are_short():
    for path in EXAMPLES.glob("*.py"):
        assert len(path.read_text().splitlines()) <= 100, path.name


def test_examples_need_no_inner_module():
    for path in EXAMPLES.glob("*.py"):
        for node in ast.walk(ast.parse(path.read_text())):
            if isinstance(node, ast.ImportFrom) and (node.module or "").startswith("osfcore"):
                assert node.module == "osfcore", f"{path.name}: {node.module}"
