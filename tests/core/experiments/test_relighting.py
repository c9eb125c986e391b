import json
from dataclasses import replace

import cv2
import pytest

import osfcore.experiments.relighting as relit
from osfcore.errors import InvalidInput, UnknownName
from osfcore.experiments.fields import MEASURES
from osfcore.fields.field_library import FieldLibrary
from tests.support.errors import about
from tests.support.solids import SOLIDS, write_nerfs


@pytest.fixture(scope="module")
def asked(tmp_path_factory):
    folder = tmp_path_factory.mktemp("relighting")
    write_nerfs(folder / "data")
    return relit.CompareRelighting(
        folder / "out", folder / "data", SOLIDS, tasks=1, methods=("nerf_fitted", "nerf", "ours"), objects=2,
        elevations_deg=(90, 15), sky=True, size=32,
    )  # fmt: skip


@pytest.fixture(scope="module")
def steps(asked, library):
    return list(relit.compare_relighting(asked, FieldLibrary(None), library))


def test_a_scene_is_shown_by_each_method_under_each_light(asked, steps):
    assert [(step.done, step.total, step.report is None) for step in steps] == [(n, 3, n < 3) for n in range(4)]
    report = steps[-1].report
    assert json.loads((asked.folder / relit.REPORT_FILE).read_text()) == report
    assert report["elevations_deg"] == [15, 90]
    assert list(report["methods"]) == ["ours", "nerf", "nerf_fitted"]
    for figures in report["methods"].values():
        assert set(figures) == set(MEASURES)
        assert all(len(row["along"]) == 3 for row in figures.values())
        assert set(figures["psnr"]["spans"]) == {"all", "15", "90", "sky"}
    means = {name: figures["psnr"]["spans"] for name, figures in report["methods"].items()}
    ours, nerf, fitted = (means[method]["all"]["mean"] for method in ("ours", "nerf", "nerf_fitted"))
    assert report["against"]["nerf"]["psnr"]["all"]["difference"] == pytest.approx(ours - nerf, abs=1e-3)
    assert ours > fitted + 2  # no brightness makes up for shadows
    assert fitted > nerf + 2  # fields without light do not know how bright the table is
    assert all(means["nerf"]["sky"]["mean"] > means["nerf"][one]["mean"] for one in ("15", "90"))  # what they learned
    height, width, _ = cv2.imread(str(asked.folder / relit.IMAGES_FILE)).shape
    assert height > 2 * 32  # lights
    assert width > 3 * 32  # simulator and methods
    assert (asked.folder / relit.CHART_FILE).exists()


def test_what_was_measured_is_taken_over(asked, steps, library, monkeypatch):
    def report_of(changed):
        *_, last = relit.compare_relighting(changed, FieldLibrary(None), library)
        return last.report

    simulated, real = [], relit.simulate_relit
    monkeypatch.setattr(relit, "simulate_relit", lambda draw, *more: simulated.append(draw) or real(draw, *more))
    assert report_of(asked) == steps[-1].report
    ours = replace(asked, methods=("ours",))
    assert report_of(ours)["methods"]["ours"] == steps[-1].report["methods"]["ours"]
    assert simulated == []
    report_of(replace(ours, tasks=2))
    assert len(simulated) == 1


@pytest.mark.parametrize("factor", ["objects_shiny", "renderer_tiny"])
def test_worlds_that_fields_do_not_know_are_shown_less_well(asked, steps, library, factor):
    *_, last = relit.compare_relighting(replace(asked, factor=factor), FieldLibrary(None), library)
    assert last.report["factor"] == factor
    known, strange = (report["methods"]["ours"]["psnr"]["spans"]["all"] for report in (steps[-1].report, last.report))
    assert strange["mean"] < known["mean"]


def test_what_cannot_be_compared_is_refused(asked, library, tmp_path):
    changes = [("methods", ("magic",)), ("tasks", 0)]
    changes += [("elevations_deg", wrong) for wrong in ((), (3.0, 20.0), (91.0,))]
    for what, wrong in changes:
        config = replace(asked, folder=tmp_path / "out", **{what: wrong})
        with pytest.raises(InvalidInput, check=about(what.removesuffix("_deg"))):
            next(relit.compare_relighting(config, FieldLibrary(None), library))
    for factor, error in (("camera_shifted", InvalidInput), ("fog", UnknownName)):  # nothing of either would be seen
        config = replace(asked, folder=tmp_path / "out", factor=factor)
        with pytest.raises(error):
            next(relit.compare_relighting(config, FieldLibrary(None), library))
    assert not (tmp_path / "out").exists()
