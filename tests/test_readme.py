"""The commands and programs of README and docs work as they stand."""

import doctest
import json
import os
import re
import shlex
import shutil
import subprocess
import sys
import textwrap
import time
from contextlib import nullcontext
from importlib.metadata import version
from pathlib import Path

import numpy as np
import pytest
import trimesh
import yaml

import osfcore
from osfcore.fields.kiloosf import read_field
from osfcore.world.collect_images import CollectObservation, collect_observation
from tests.live import live_service

ROOT = Path(__file__).parents[1]
README = (ROOT / "README.md").read_text()
GUIDES = [
    ROOT / "README.md",
    *(
        ROOT / "docs" / f"{name}.md"
        for name in (
            "reference/command-line",
            "reference/exchange",
            "reference/rest",
            "how-to/own-objects",
            "explanation/evaluation",
            "how-to/photos",
        )
    ),
]
TUTORIALS = sorted((ROOT / "docs" / "tutorials").glob("*.md"))
REFERENCE = sorted((ROOT / "docs" / "reference" / "python").glob("*.md"))
OSF = Path(sys.executable).with_name("osf")


def blocks(language: str) -> list[str]:
    """Blocks of code of all guides, in the order in which they build on each other."""
    return code("".join(guide.read_text() for guide in GUIDES), language)


def code(text: str, language: str) -> list[str]:
    """Blocks of code of a text; those of list items are indented."""
    return [textwrap.dedent(block) for block in re.findall(rf"```(?:{language})\n(.*?)```", text, flags=re.DOTALL)]


def test_make_targets_exist():
    targets = [line.split()[1] for block in blocks("sh") for line in block.splitlines() if line.startswith("make ")]
    assert {"demo", "test"} <= set(targets)
    for target in {*targets, *re.findall(r"`make ([\w-]+)`", README)}:
        done = subprocess.run(["make", "-n", target], cwd=Path(__file__).parents[1], capture_output=True, check=False)
        assert done.returncode == 0, target


@pytest.mark.slow
def test_commands_run(data_dir, tmp_path, record_property):
    commands = [line for block in blocks("sh") for line in block.splitlines() if line.startswith(("osf ", "echo "))]
    assert len(commands) >= 7
    box = trimesh.creation.box((0.08, 0.05, 0.03))
    box.export(tmp_path / "mesh.obj")
    for command in commands:
        environment = {**os.environ, "OSF_DATA_DIR": str(data_dir), "PATH": f"{OSF.parent}:{os.environ['PATH']}"}
        began = time.monotonic()
        done = subprocess.run(
            ["sh", "-c", command], cwd=tmp_path, env=environment, capture_output=True, text=True, check=False
        )
        record_property(command, f"{time.monotonic() - began:.1f} s")  # what a run in CI spends them on
        assert done.returncode == 0, f"{command}: {done.stderr[-500:]}"
    assert json.loads((tmp_path / "table.json").read_text())["psnr"] > 20
    for name in ("mustard", "gelatin"):
        assert read_field(tmp_path / "fields" / f"{name}.safetensors").hidden > 0
    page = (tmp_path / "report" / "report.html").read_text()
    assert "Where episodes fail" in page
    assert "A quick look and no measurement: 1 task a cell, 1 action instead of 30" in page
    (section,) = json.loads((tmp_path / "report" / "reproduction.json").read_text())["sections"]
    assert all(cell["figures"]["steps_median"] <= 1 for cell in section["cells"])


def test_tutorials_show_commands_that_other_tests_run():
    """Those of the guides, and of the pages on robots and on extending, which have tests of their own."""
    pages = [*GUIDES, *(ROOT / "docs" / "how-to" / f"{name}.md" for name in ("robots", "extending"))]
    text = "".join(page.read_text() for page in pages)
    tested = {line for block in code(text, "sh|console") for line in block.splitlines()}
    assert TUTORIALS
    for page in TUTORIALS:
        shown = code(page.read_text(), "console")
        assert {line for block in shown for line in block.splitlines()} <= tested, page.name
        assert "```sh" not in page.read_text(), page.name


@pytest.fixture(scope="module")
def seen(library, tmp_path_factory):
    """An observation that is soon estimated, as `osf collect observation` leaves it."""
    place = tmp_path_factory.mktemp("readme") / "seen"
    collect_observation(CollectObservation(place, ("006_mustard_bottle",), size=64), library)
    return place


@pytest.mark.slow
def test_rest_examples_run(data_dir, tmp_path):
    with live_service(data_dir) as url:  # each block goes on where the one before ended
        program = "".join(blocks("python")).replace("http://127.0.0.1:8000", url)
        environment = {**os.environ, "OSF_DATA_DIR": str(data_dir)}
        command = [sys.executable, "-c", program]
        done = subprocess.run(
            command, cwd=tmp_path, env=environment, capture_output=True, text=True, check=False, timeout=900
        )
        assert done.returncode == 0, done.stderr[-500:]
        drive_with_curl(url, tmp_path)
    (before, after), (pushed_on, let_be) = (
        np.array(re.findall(r"-?\d+\.\d+", line), float).reshape(2, 3)
        for line in done.stdout.splitlines()
        if "the box" in line
    )
    assert np.linalg.norm(after - before) > 0.03
    assert np.linalg.norm(pushed_on - after) > 0.03
    np.testing.assert_allclose(let_be, after, atol=1e-3)
    assert "trusted: " in done.stdout
    assert "'light_deg': " in done.stdout
    assert "episode: done The table looks like the goal." in done.stdout
    assert "the table was found by the objects" in done.stdout
    for image in ("goal.png", "compared.png", "photo.png", "drawing.png"):
        assert (tmp_path / image).read_bytes().startswith(b"\x89PNG")
    assert (tmp_path / "video.mp4").read_bytes()[4:8] == b"ftyp"


def drive_with_curl(url, place):
    """The commands that drive an episode, each with what the ones before have answered; photo and table are there."""
    if shutil.which("curl") is None:
        return
    (place / "video.mp4").unlink()
    (commands,) = (block.splitlines() for block in blocks("sh") if "/api/episodes" in block)
    ids = {}
    for command in commands:
        text = command.replace("http://127.0.0.1:8000", url)
        for name, found in ids.items():
            text = text.replace(name, found)
        done = subprocess.run(shlex.split(text), cwd=place, capture_output=True, text=True, check=False, timeout=600)
        assert done.returncode == 0, f"{command}: {done.stderr[-500:]}"
        if done.stdout.startswith("{"):
            ids["EPISODE" if "settings" in command else "GOAL"] = json.loads(done.stdout)["id"]
    assert set(ids) == {"GOAL", "EPISODE"}


@pytest.mark.slow
def test_an_observation_is_sent_as_written(data_dir, tmp_path, seen):
    if shutil.which("curl") is None:
        pytest.skip("curl is not on this machine")
    shutil.copytree(seen, tmp_path / "seen")
    lines = (line for block in blocks("sh") if "/api/episodes" not in block for line in block.splitlines())
    commands = [line for line in lines if line.startswith(("curl ", "python3 "))]
    assert len(commands) >= 3
    told = []
    with live_service(data_dir) as url:
        for command in commands:
            arguments = shlex.split(command.replace("http://127.0.0.1:8000", url))
            arguments[0] = sys.executable if arguments[0] == "python3" else arguments[0]
            done = subprocess.run(arguments, cwd=tmp_path, capture_output=True, text=True, check=False, timeout=60)
            assert done.returncode == 0, f"{command}: {done.stderr[-500:]}"
            told.append(done.stdout)
    sent, listed = (json.loads(text) for text in told[1:])
    assert (sent["objects"], sent["seed"], sent["of"]["file_name"]) == (["006_mustard_bottle"], 1, "observation.zip")
    assert [estimate["id"] for estimate in listed["estimates"]] == [sent["id"]]


@pytest.mark.slow
@pytest.mark.parametrize("page", [page for page in REFERENCE if page.stem != "index"], ids=lambda page: page.stem)
def test_examples_of_the_python_reference_run(page, data_dir, tmp_path):
    (program,) = re.findall(r"```python\n(.*?)```", page.read_text(), flags=re.DOTALL)
    environment = {**os.environ, "OSF_DATA_DIR": str(data_dir)}
    with live_service(data_dir) if page.stem == "client" else nullcontext("") as url:
        command = [sys.executable, "-c", program.replace("http://127.0.0.1:8000", url)]
        done = subprocess.run(command, cwd=tmp_path, env=environment, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr[-500:]
    assert done.stdout


@pytest.fixture(scope="module")
def example_names(library):
    """The public names, and what the program at the top of the reference defines; the meshes are those of tests."""
    names = {name: getattr(osfcore, name) for name in osfcore.__all__}
    exec(*code((ROOT / "docs" / "reference" / "python" / "index.md").read_text(), "python"), names)
    return names | {"assets": library}


@pytest.mark.parametrize("name", osfcore.__all__)
def test_each_public_name_has_an_example_that_runs(name, example_names, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    (example,) = doctest.DocTestFinder(recurse=False).find(example_names[name], name, globs=example_names)
    assert example.examples
    assert doctest.DocTestRunner(optionflags=doctest.ELLIPSIS).run(example).failed == 0


def test_the_python_reference_has_every_public_name():
    text = "".join(page.read_text() for page in REFERENCE)
    assert set(osfcore.__all__) <= set(re.findall(r"\.\. auto\w+:: (?:osfcore\.)?(\w+)\n", text))
    (lists,) = (page.read_text() for page in REFERENCE if page.stem == "index")
    assert set(osfcore.__all__) == set(re.findall(r"^   (\w+)$", lists, flags=re.MULTILINE))


def test_the_citation_is_of_this_version_and_of_the_paper():
    cited = yaml.safe_load((ROOT / "CITATION.cff").read_text())
    assert cited["version"] == version("osf-manipulation")
    assert cited["preferred-citation"]["url"] in README


@pytest.mark.parametrize("page", [*ROOT.glob("*.md"), *ROOT.glob("docs/**/*.md")], ids=lambda page: page.name)
def test_links_lead_somewhere(page):
    for link, anchor in re.findall(r"\]\(([^)#:]*)(?:#([\w-]+))?\)", page.read_text()):
        target = page.parent / link if link else page
        assert target.exists(), link
        assert not anchor or anchor in anchors(target), f"{link}#{anchor}"


def anchors(page: Path) -> set[str]:
    """Return where links can lead within a page: its headings as GitHub and the site call them, and MyST's targets."""
    text = re.sub(r"```.*?```", "", page.read_text(), flags=re.DOTALL)
    headings = re.findall(r"^#+ (.+)$", text, flags=re.MULTILINE)
    targets = re.findall(r"^\(([\w-]+)\)=$", text, flags=re.MULTILINE)
    return {re.sub(r"[^\w -]", "", heading.lower()).replace(" ", "-") for heading in headings} | set(targets)


def test_the_readme_is_short():
    assert len(README.split()) <= 700
