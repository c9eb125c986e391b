import json
from dataclasses import replace

import cv2
import numpy as np
import pytest

import osfcore.experiments.relighting as relit
from osfcore.errors import InvalidInput
from osfcore.experiments.images import FIELD_METHODS
from osfcore.experiments.relighting import (
    CHART_FILE,
    IMAGES_FILE,
    MEASURES,
    REPORT_FILE,
    CompareRelighting,
    RelitScenes,
    compare_relighting,
)
from osfcore.fields.field_library import FieldLibrary
from osfcore.world.tasks import draw_scene
from tests.core.experiments.nerfs import write_nerfs
from tests.core.experiments.solids import SOLIDS


def config(folder, **changes) -> CompareRelighting:
    given = CompareRelighting(
        folder / "out", folder / "data", SOLIDS, tasks=1, objects=2, elevations_deg=(90, 15, 45), size=32
    )  # fmt: skip
    return replace(given, **changes)


def report_of(asked, library):
    *_, last = compare_relighting(asked, FieldLibrary(None), library)
    return last.report


@pytest.fixture(scope="module")
def compared(library, tmp_path_factory):
    folder = tmp_path_factory.mktemp("relighting")
    write_nerfs(folder / "data")
    asked = config(folder)
    return asked, list(compare_relighting(asked, FieldLibrary(None), library))


@pytest.mark.slow
def test_a_scene_is_shown_by_all_methods_under_all_lights(compared):
    asked, steps = compared
    assert [(step.done, step.total) for step in steps] == [(n, 3) for n in range(4)]
    assert [step.report is None for step in steps] == [True, True, True, False]
    report = steps[-1].report
    assert json.loads((asked.folder / REPORT_FILE).read_text()) == report
    assert report["elevations_deg"] == [15, 45, 90]
    assert report["names"] == list(SOLIDS)
    assert list(report["methods"]) == list(FIELD_METHODS)
    for figures in report["methods"].values():
        assert set(figures) == set(MEASURES)
        assert all(len(row["along"]) == 3 for row in figures.values())
        assert set(figures["psnr"]["spans"]) == {"all", "15", "45", "90"}
    ours, nerf = (report["methods"][method]["psnr"]["spans"]["all"]["mean"] for method in ("ours", "nerf"))
    assert report["against"]["nerf"]["psnr"]["all"]["difference"] == pytest.approx(ours - nerf, abs=1e-3)
    assert ours > nerf + 5  # fields without light do not know how bright the table is


def test_pictures_show_the_first_scene_and_all_methods(compared):
    asked, _ = compared
    image = cv2.imread(str(asked.folder / IMAGES_FILE))
    assert image is not None
    assert image.shape[0] > 3 * 32  # lights
    assert image.shape[1] > 4 * 32  # simulator and methods
    assert (asked.folder / CHART_FILE).exists()


def test_what_was_measured_is_taken_over(compared, library, monkeypatch):
    asked, steps = compared
    asked_for, real = [], relit.simulate_relit
    monkeypatch.setattr(relit, "simulate_relit", lambda draw, *more: asked_for.append(draw) or real(draw, *more))
    assert report_of(asked, library) == steps[-1].report
    less = report_of(replace(asked, methods=("ours",)), library)
    assert less["methods"]["ours"] == steps[-1].report["methods"]["ours"]
    assert asked_for == []
    report_of(replace(asked, methods=("ours",), tasks=2), library)
    assert len(asked_for) == 1


def test_the_truth_itself_is_perfect(library, tmp_path, monkeypatch):
    monkeypatch.setattr(relit, "render_scene", lambda _renderer, truth: truth.images)
    scenes = RelitScenes(FieldLibrary(None), library, tmp_path, (10.0, 60.0), 32)
    result = scenes.measure(draw_scene(SOLIDS, 2, 0, 0), "ours")
    assert result.figures["psnr"] == result.figures["psnr_object"] == [100, 100]
    np.testing.assert_allclose(result.figures["ssim"], 1, atol=1e-12)
    assert set(result.figures["psnr_shadow"]) <= {100, None}
    assert [shown.label for shown in result.shown] == ["10 deg", "60 deg"]
    for shown in result.shown:
        np.testing.assert_array_equal(shown.truth, shown.ours)


@pytest.mark.parametrize(
    ("changes", "words"),
    [
        ({"tasks": 0}, "number of tasks is 0"),
        ({"objects": 0}, "objects in a scene is 0"),
        ({"objects": 4}, "at least 4"),
        ({"seed": -1}, "seed"),
        ({"size": 8}, "image size"),
        ({"methods": ("magic",)}, "magic"),
        ({"elevations_deg": ()}, "none"),
        ({"elevations_deg": (3.0, 20.0)}, "3, 20"),
        ({"elevations_deg": (91.0,)}, "between 5 and 90"),
    ],
)
def test_a_mistake_is_one_sentence(library, tmp_path, changes, words):
    write_nerfs(tmp_path / "data")
    with pytest.raises(InvalidInput, match=words):
        report_of(config(tmp_path, **changes), library)
    assert not (tmp_path / "out").exists()
