import json
import re
from dataclasses import replace

import pytest

from osfcore.control.events import EpisodeSettings
from osfcore.errors import InvalidInput
from osfcore.experiments.reproduction.reproduction import FIGURES_FILE, PAGE_FILE, About, Reproduce, reproduce
from osfcore.experiments.reproduction.sections import QUICK
from osfcore.experiments.rivals.fitvid import FitVidModel, FitVidSettings, write_fitvid
from osfcore.fields.field_library import FieldLibrary
from osfcore.planning.mppi import PlanSettings

NAME = "005_tomato_soup_can"
SMALLEST = replace(
    QUICK, tasks=2, headline=2, counts=(1,), objects=1, settings=EpisodeSettings(steps=2, plan=PlanSettings(samples=8))
)


@pytest.fixture(autouse=True)
def network(tmp_path):
    """A video prediction that nothing asks."""
    write_fitvid(tmp_path / "data" / "fitvid.safetensors", FitVidModel(FitVidSettings(16, 1, 2, 2, 1)).eval())


def config(folder, **changes):
    about = About("today", "a <machine>", "osf reproduce", 0, ())
    given = Reproduce(folder / "out", folder / "data", about, SMALLEST, is_quick=True, names=(NAME,))
    return replace(given, **changes)


def last(steps):
    *_, step = steps
    return step


@pytest.fixture
def reported(library, tmp_path, runs):
    asked = config(tmp_path, parts=("methods", "factors", "attribution"))
    report = last(reproduce(asked, FieldLibrary(None), library)).report
    return asked, report, (asked.folder / PAGE_FILE).read_text()


def test_a_report_holds_all_cells_in_tables_and_pictures(reported):
    asked, report, page = reported
    assert json.loads((asked.folder / FIGURES_FILE).read_text()) == json.loads(json.dumps(report))
    assert [section["name"] for section in report["sections"]] == ["methods", "factors", "attribution"]
    for section in report["sections"]:
        assert section["title"] in page
        for cell in section["cells"]:
            assert re.search(rf"<td>{re.escape(cell['label'])}</td>", page), cell["label"]
            assert cell["figures"]["tasks"] == 2
    for picture in ("success.png", "factors.png", "attribution.png"):
        assert (asked.folder / picture).read_bytes().startswith(b"\x89PNG")
    assert page.count("data:image/png;base64,") == 3
    assert "told the truth" in page
    assert page.count("<td>no action</td>") == 3


def test_the_page_needs_nothing_beside_it_and_warns_of_little(reported):
    _, _, page = reported
    sources = re.findall(r'(?:src|href)="([^"]*)"', page)
    assert sources
    assert all(source.startswith("data:") for source in sources)
    assert "a &lt;machine&gt;" in page
    assert "A quick look and no measurement: 2 tasks a cell" in page
    assert "Parts left out: relighting, video, families, ablations, ladder." in page


def test_findings_compare_methods_on_the_same_tasks(reported):
    _, report, page = reported
    told = report["findings"]
    compared = [line for line in told if "ours and" in line]
    assert len(compared) == 2 * 4  # by both kinds of success
    assert any(
        "ours and visual foresight" in line and "50 % against 0 %, which is +50 points" in line for line in compared
    )
    assert all("no difference is shown" in line for line in compared)  # two tasks cannot show any
    assert any("mean 6D pose distance" in line for line in told)
    assert all(line.split(":")[0] in page for line in told)


def test_episodes_that_several_sections_show_are_run_once(library, tmp_path, runs):
    parts = ("factors", "attribution")
    last(reproduce(config(tmp_path, parts=parts), FieldLibrary(None), library))
    usual, factors, attributed = 2, 2, 5 * 2
    assert len(runs) == usual + factors + attributed
    runs.clear()
    last(reproduce(config(tmp_path, parts=("ladder",)), FieldLibrary(None), library))
    assert len(runs) == 3 * 2  # all rungs but ours


def test_another_plan_takes_over_no_episode(library, tmp_path, runs):
    last(reproduce(config(tmp_path, parts=("attribution",)), FieldLibrary(None), library))
    first = len(runs)
    longer = replace(SMALLEST, settings=EpisodeSettings(steps=2, plan=PlanSettings(samples=9)))
    for scale in (longer, SMALLEST):
        last(reproduce(config(tmp_path, parts=("attribution",), scale=scale), FieldLibrary(None), library))
    assert len(runs) == 2 * first


def test_progress_counts_episodes(library, tmp_path, runs):
    steps = list(reproduce(config(tmp_path, parts=("attribution",)), FieldLibrary(None), library))
    assert [step.done for step in steps[:-1]] == list(range(12))
    assert {step.total for step in steps[:-1]} == {12}
    assert [step.report is None for step in steps] == [True] * 12 + [False]


@pytest.mark.slow
def test_images_are_compared_as_well(library, tmp_path):
    few = replace(SMALLEST, scenes=1, videos=1)
    asked = config(tmp_path, parts=("relighting", "video"), scale=few)
    (asked.data_dir / "fitvid.safetensors").unlink()  # the package's predicts in its stead
    report = last(reproduce(asked, FieldLibrary(None), library)).report
    page = (asked.folder / PAGE_FILE).read_text()
    assert list(report["relighting"]["methods"]) == ["ours", "paper", "nerf"]
    assert list(report["video"]["methods"]) == ["copied", "ours", "paper", "nerf", "fitvid"]
    assert page.count("data:image/png;base64,") == 4
    gap = report["relighting"]["against"]["nerf"]["psnr"]["all"]["difference"]
    assert gap > 3
    assert f">{gap:.3g}<" in page  # of one scene there is no interval


@pytest.mark.parametrize(
    ("changes", "words"),
    [
        ({"parts": ("luck",)}, "part of the report is luck"),
        ({"scale": replace(SMALLEST, tasks=0, headline=0), "parts": ("methods",)}, "number of tasks is 0"),
    ],
)
def test_a_mistake_is_one_sentence(library, tmp_path, changes, words):
    with pytest.raises(InvalidInput, match=words):
        last(reproduce(config(tmp_path, **changes), FieldLibrary(None), library))
