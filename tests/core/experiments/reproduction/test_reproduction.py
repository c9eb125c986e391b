import json
import re
from dataclasses import replace
from itertools import combinations, pairwise
from pathlib import Path

import pytest
from markdown_it import MarkdownIt

from osfcore.control.events import EpisodeSettings
from osfcore.errors import InvalidInput
from osfcore.experiments.factors import EPISODE_FACTORS
from osfcore.experiments.rearrangement import EvaluateMpc, evaluate_mpc
from osfcore.experiments.rearrangement_runs import Variant, check_variant
from osfcore.experiments.reproduction.reproduction import (
    FIGURES_FILE,
    MARKDOWN_FILE,
    PAGE_FILE,
    QUICK,
    SECTIONS,
    About,
    Reproduce,
    Scale,
    reproduce,
    sections_of,
)
from osfcore.experiments.rivals.fitvid import FitVidModel, FitVidSettings, write_fitvid
from osfcore.fields.field_library import FieldLibrary
from osfcore.planning.mppi import PlanSettings
from tests.support.errors import about as error_about
from tests.support.photographs import NAME as BOX
from tests.support.photographs import take, write_photo

NAME = "005_tomato_soup_can"
SMALLEST = replace(
    QUICK, tasks=2, headline=2, counts=(1,), objects=1, settings=EpisodeSettings(steps=2, plan=PlanSettings(samples=8))
)


@pytest.fixture(autouse=True)
def network(tmp_path):
    """A video prediction that nothing asks."""
    write_fitvid(tmp_path / "data" / "fitvid.safetensors", FitVidModel(FitVidSettings(16, 1, 2, 2, 1)).eval())


def config(folder, **changes):
    given = Reproduce(
        folder / "out", folder / "data", About("today", "a <machine>", "osf reproduce", 0, ()), SMALLEST, is_quick=True,
        names=(NAME,),
    )  # fmt: skip
    return replace(given, **changes)


def reproduced(library, asked):
    return list(reproduce(asked, FieldLibrary(None), library))


@pytest.mark.slow
def test_a_report_holds_all_cells_and_needs_nothing_beside_it(library, tmp_path, runs):
    asked = config(tmp_path, parts=("methods", "factors", "attribution"))
    report = reproduced(library, asked)[-1].report
    page = (asked.folder / PAGE_FILE).read_text()
    assert json.loads((asked.folder / FIGURES_FILE).read_text()) == json.loads(json.dumps(report))
    assert [section["name"] for section in report["sections"]] == ["methods", "factors", "attribution"]
    for section in report["sections"]:
        assert section["title"] in page
        for cell in section["cells"]:
            assert f"<td>{cell['label']}</td>" in page
            assert cell["figures"]["tasks"] == 2
    assert page.count("<svg ") == 3
    assert all(source.startswith("#") for source in re.findall(r'(?:src|href)="([^"]*)"', page))
    assert "told the truth" in page
    assert page.count("<td>no action</td>") == 3
    assert "a &lt;machine&gt;" in page
    assert page.count('class="note"') == 2  # it is quick, and parts are left out
    compared = [line for line in report["findings"] if "ours and" in line]
    assert len(compared) == 4
    (line,) = (line for line in compared if "visual foresight" in line)
    assert "2 tasks" in line
    assert line.count("no difference is shown (+50 points") == 2  # two tasks cannot show any; by both kinds of success
    assert all(line in page for line in report["findings"])


@pytest.mark.slow
def test_a_report_is_also_a_page_for_a_site(library, tmp_path, runs):
    given = About("today", "a <machine>", "osf reproduce --out my_report", 0, ())
    asked = config(tmp_path, parts=("attribution",), about=given)
    reproduced(library, asked)
    text = (asked.folder / MARKDOWN_FILE).read_text()
    html = MarkdownIt("commonmark").enable("table").render(text)
    page = (asked.folder / PAGE_FILE).read_text()
    tables = [re.findall(r"<td[^>]*>(.*?)</td>", shown) for shown in (page, html)]
    assert tables[0] == tables[1] != []
    assert "<h2>Where episodes fail</h2>" in html
    assert "a &lt;machine&gt;" in html
    assert "osf reproduce --out my_report\n" in html
    assert "<em>" not in html
    (svg,) = re.findall(r"<svg .*?</svg>", html)
    assert svg in page


@pytest.mark.slow
def test_finished_episodes_are_reported_with_their_number_and_no_others_are_run(library, tmp_path, runs):
    asked = config(tmp_path, parts=("methods", "factors"), is_finished=True)
    ours = EvaluateMpc(
        asked.folder, asked.data_dir, 2, 1, actions=2, names=(NAME,), oracle=False, settings=SMALLEST.settings,
        foresight=SMALLEST.foresight,
    )  # fmt: skip
    for one in (ours, *(replace(ours, tasks=1, variant=Variant(method)) for method in ("nerf", "foresight"))):
        list(evaluate_mpc(one, FieldLibrary(None), library))
    runs.clear()
    (section,) = reproduced(library, asked)[-1].report["sections"]
    assert {cell["label"]: cell["figures"]["tasks"] for cell in section["cells"]} == {
        "ours": 2, "compositional NeRF": 1, "visual foresight": 1
    }  # fmt: skip
    assert [cell["against_first"]["tasks"] for cell in section["cells"][1:]] == [1, 1]
    text = (asked.folder / MARKDOWN_FILE).read_text()
    for words in ("as published, light known, told the truth", "Factors of variation"):
        (line,) = (line for line in text.splitlines() if words in line)
        assert "left out" in line.lower()

    def lose(method):
        (path,) = asked.folder.glob(f"mpc/*/{method}*/0000.json")
        path.unlink()

    lose("nerf")
    (section,) = reproduced(library, asked)[-1].report["sections"]
    assert [cell["label"] for cell in section["cells"]] == ["ours", "visual foresight"]
    lose("ours")  # without the first task, the second would be a choice of what is fast
    with pytest.raises(InvalidInput, check=error_about("finished episodes")):
        reproduced(library, asked)
    assert runs == []


@pytest.mark.slow
def test_episodes_that_several_sections_show_are_run_once(library, tmp_path, runs):
    steps = reproduced(library, config(tmp_path, parts=("factors", "attribution")))
    usual, factors, attributed = 2, 2, 5 * 2
    count = usual + factors + attributed
    assert len(runs) == count
    assert [(step.done, step.total) for step in steps[:-1]] == [(n, count) for n in range(count)]
    runs.clear()
    reproduced(library, config(tmp_path, parts=("ladder",)))
    assert len(runs) == 3 * 2  # all rungs but ours


@pytest.mark.slow
def test_images_are_compared_as_well(library, tmp_path):
    few = replace(SMALLEST, scenes=1, videos=1)
    asked = config(tmp_path, parts=("relighting", "video"), scale=few)
    (asked.data_dir / "fitvid.safetensors").unlink()  # the package's predicts in its stead
    report = reproduced(library, asked)[-1].report
    page = (asked.folder / PAGE_FILE).read_text()
    assert list(report["relighting"]["methods"]) == ["ours", "paper", "nerf", "nerf_fitted"]
    assert list(report["video"]["methods"]) == ["copied", "ours", "paper", "nerf", "fitvid"]
    assert (page.count("data:image/webp;base64,"), page.count("<svg ")) == (2, 4)
    gap = report["relighting"]["against"]["nerf"]["psnr"]["all"]["difference"]
    assert gap > 3
    assert f">{gap:.3g}<" in page  # of one scene there is no interval


@pytest.mark.slow
def test_estimates_and_predicted_poses_are_reported(library, tmp_path):
    few = replace(SMALLEST, frames=1, pushes=1)
    names = ("003_cracker_box", NAME, "009_gelatin_box")
    report = reproduced(library, config(tmp_path, parts=("estimation", "dynamics"), scale=few, names=names))[-1].report
    page = (tmp_path / "out" / PAGE_FILE).read_text()
    assert (page.count("data:image/webp;base64,"), page.count("<svg ")) == (1, 5)
    for method in ("ours", "paper"):
        assert report["estimation"]["methods"][method]["frames"] == 1
        error = report["dynamics"][method]["median_mm_4"]
        assert f">{error:.3g}<" in page
    assert "<td>no motion</td>" in page


@pytest.mark.slow
def test_photographs_are_reported_where_there_are_any(library, tmp_path):
    pictured = tmp_path / "photos"
    (pictured / "desk").mkdir(parents=True)
    write_photo(pictured / "desk", take({BOX: FieldLibrary(None).load(BOX)}))
    asked = config(tmp_path, parts=("photos",), photos=pictured)
    report = reproduced(library, asked)[-1].report
    assert [score["scene"] for score in report["photos"]["none"]["scores"]] == ["desk"]
    assert "<td>desk</td>" in (asked.folder / PAGE_FILE).read_text()
    assert "photos" not in reproduced(library, replace(asked, photos=None))[-1].report
    with pytest.raises(InvalidInput, check=error_about("photographs")):  # before any work
        next(reproduce(replace(asked, photos=tmp_path / "out"), FieldLibrary(None), library))


# Sections


BASE = EvaluateMpc(Path("out"), Path("data"), names=("a", "b"), seed=7)


def named(name):
    return [section for section in sections_of(BASE, Scale()) if section.name == name]


@pytest.mark.parametrize("scale", [Scale(), QUICK], ids=["full", "quick"])
def test_cells_of_a_section_differ_but_have_the_same_tasks(scale):
    for section in sections_of(BASE, scale):
        assert len({cell.label for cell in section.cells}) == len(section.cells) > 1
        for one, other in combinations((cell.config for cell in section.cells), 2):
            assert one != other
            assert all(getattr(one, key) == getattr(other, key) for key in ("seed", "names", "tasks", "objects"))
        for cell in section.cells:
            check_variant(cell.config.variant)


def test_a_full_report_has_what_was_asked_for():
    methods = named("methods")
    firsts = [section.cells[0].config for section in methods]
    assert [(c.objects, c.family, c.tasks) for c in firsts] == [
        (2, "shifted", 50), (3, "shifted", 100), (4, "shifted", 50), (3, "upright", 50),
    ]  # fmt: skip
    assert all(cell.config.actions == cell.config.settings.steps == 30 for s in methods for cell in s.cells)
    assert [cell.config.oracle for cell in methods[1].cells] == [True, False, False, False, False, False]
    (factors,) = named("factors")
    assert {cell.config.factor for cell in factors.cells} == {"", *EPISODE_FACTORS}
    assert {section.name for section in sections_of(BASE, Scale())} == set(SECTIONS)
    assert {section.name for section in sections_of(BASE, Scale(), ("ladder",))} == {"ladder"}


def test_the_ladder_leads_from_the_paper_to_ours():
    (ladder,) = named("ladder")
    rungs = [cell.config.variant for cell in ladder.cells]
    assert rungs[0] == Variant("paper")
    assert rungs[-1] == Variant("ours")
    for lower, higher in pairwise(rungs[:-1]):
        assert lower.replaced < higher.replaced
        assert len(higher.replaced - lower.replaced) == 1
