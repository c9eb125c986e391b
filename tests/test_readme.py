"""The README's commands work as they stand."""

import os
import re
import subprocess
import sys
from pathlib import Path

import pytest
import trimesh

from tests.live import live_service

README = (Path(__file__).parents[1] / "README.md").read_text()
OSF = Path(sys.executable).with_name("osf")


def blocks(language: str) -> list[str]:
    return re.findall(rf"```{language}\n(.*?)```", README, flags=re.DOTALL)


def test_make_targets_exist():
    targets = [line.split()[1] for block in blocks("sh") for line in block.splitlines() if line.startswith("make ")]
    assert {"demo", "test"} <= set(targets)
    for target in {*targets, *re.findall(r"`make (\w+)`", README)}:
        done = subprocess.run(["make", "-n", target], cwd=Path(__file__).parents[1], capture_output=True, check=False)
        assert done.returncode == 0, target


def test_commands_run(data_dir, tmp_path):
    commands = [line for block in blocks("sh") for line in block.splitlines() if line.startswith("osf ")]
    assert len(commands) >= 7
    box = trimesh.creation.box((0.08, 0.05, 0.03))
    box.export(tmp_path / "mesh.obj")
    for command in commands:
        arguments = [str(OSF), *command.split()[1:]]
        environment = {**os.environ, "OSF_DATA_DIR": str(data_dir)}
        done = subprocess.run(arguments, cwd=tmp_path, env=environment, capture_output=True, text=True, check=False)
        assert done.returncode == 0, f"{command}: {done.stderr[-500:]}"


def test_rest_example_runs(data_dir, tmp_path):
    (program,) = blocks("python")
    with live_service(data_dir) as url:
        program = program.replace("http://127.0.0.1:8000", url)
        done = subprocess.run(
            [sys.executable, "-c", program], cwd=tmp_path, capture_output=True, text=True, check=False, timeout=120
        )
    assert done.returncode == 0, done.stderr[-500:]
    assert "pusher went from" in done.stdout
    assert (tmp_path / "goal.png").read_bytes().startswith(b"\x89PNG")


@pytest.mark.parametrize("link", re.findall(r"\]\(([^)#:]+)\)", README))
def test_links_lead_somewhere(link):
    assert (Path(__file__).parents[1] / link).exists()
