import json
from dataclasses import replace

import cv2
import numpy as np
import pytest

import osfcore.experiments.estimation_tasks as tasks
import osfcore.experiments.video_prediction as videos
from osfcore.errors import CorruptFile, InvalidInput
from osfcore.experiments.rivals.fitvid import FitVidModel, FitVidSettings, write_fitvid
from osfcore.experiments.video_prediction import CHART_FILE, IMAGES_FILE, REPORT_FILE, CompareVideos, compare_videos
from osfcore.fields.field_library import FieldLibrary
from tests.core.experiments.nerfs import write_nerfs
from tests.core.experiments.solids import SOLIDS

pytestmark = pytest.mark.usefixtures("one_thread")


def config(folder, **changes) -> CompareVideos:
    given = CompareVideos(folder / "out", folder / "data", SOLIDS, tasks=1, objects=2, steps=12, size=16)
    return replace(given, **changes)


def report_of(asked, library):
    *_, last = compare_videos(asked, FieldLibrary(None), library)
    return last.report


def write_weights(folder):
    write_nerfs(folder / "data")
    write_fitvid(folder / "data" / "fitvid.safetensors", FitVidModel(FitVidSettings(16, 1, 2, 2, 1)).eval())


def grey(video, *_):
    """In the place of predictions that take long."""
    return np.full_like(video.frames, 0.5)


@pytest.fixture(scope="module")
def compared(library, tmp_path_factory):
    folder = tmp_path_factory.mktemp("video")
    write_weights(folder)
    asked = config(folder)
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(tasks, "PUSHED_M", 0.0)
        patch.setattr(videos, "predict_through_fields", grey)
        yield asked, list(compare_videos(asked, FieldLibrary(None), library))


@pytest.mark.slow
def test_an_episode_is_predicted_by_all_methods(compared):
    asked, steps = compared
    assert [(step.done, step.total) for step in steps] == [(n, 5) for n in range(6)]
    assert [step.report is None for step in steps] == [True] * 5 + [False]
    report = steps[-1].report
    assert json.loads((asked.folder / REPORT_FILE).read_text()) == report
    assert list(report["methods"]) == ["copied", "ours", "paper", "nerf", "fitvid"]
    for figures in report["methods"].values():
        for row in figures.values():
            assert len(row["along"]) == 12
            assert set(row["spans"]) == {"10", "12"}
            assert row["spans"]["10"]["mean"] == pytest.approx(np.mean(row["along"][:10]), rel=1e-4)
    assert report["methods"]["ours"] == report["methods"]["paper"] == report["methods"]["nerf"]
    even = {"difference": 0, "interval": None}
    assert report["against"]["paper"]["psnr"] == {"10": even, "12": even}
    copied = [report["methods"][who]["mse"]["spans"]["12"]["mean"] for who in ("ours", "copied")]
    told = report["against"]["copied"]["mse"]["12"]["difference"]
    assert told == pytest.approx(copied[0] - copied[1], abs=1e-6)


@pytest.mark.slow
def test_pictures_show_the_first_episode(compared):
    asked, _ = compared
    image = cv2.imread(str(asked.folder / IMAGES_FILE))
    assert image is not None
    assert image.shape[0] > 6 * 16  # simulator and methods
    assert image.shape[1] > 2 * 16  # steps 1 and 10
    assert (asked.folder / CHART_FILE).exists()


@pytest.mark.slow
def test_what_was_predicted_is_taken_over_method_by_method(compared, library, monkeypatch):
    asked, steps = compared
    measured, real = [], videos.simulate_video
    monkeypatch.setattr(videos, "simulate_video", lambda *given: measured.append(given) or real(*given))
    assert report_of(asked, library) == steps[-1].report
    assert report_of(replace(asked, methods=("ours",)), library)["against"] == {}
    assert measured == []
    write_fitvid(asked.data_dir / "fitvid.safetensors", FitVidModel(FitVidSettings(16, 1, 2, 3, 1)).eval())
    report_of(asked, library)
    assert len(measured) == 1  # of the network that is another one


@pytest.mark.parametrize(
    ("changes", "words"),
    [
        ({"tasks": 0}, "number of tasks is 0"),
        ({"objects": 4}, "at least 4"),
        ({"steps": 0}, "predicted steps is 0"),
        ({"steps": 500}, "predicted steps is 500"),
        ({"seed": -1}, "seed"),
        ({"methods": ()}, "methods"),
        ({"size": 32}, "16, as FitVid's network has"),
    ],
)
def test_a_mistake_is_one_sentence(library, tmp_path, changes, words):
    write_weights(tmp_path)
    with pytest.raises(InvalidInput, match=words):
        report_of(config(tmp_path, **changes), library)
    assert not (tmp_path / "out").exists()


def test_a_broken_network_is_told(library, tmp_path):
    write_weights(tmp_path)
    (tmp_path / "data" / "fitvid.safetensors").write_bytes(b"broken")
    with pytest.raises(CorruptFile, match="fitvid"):
        report_of(config(tmp_path), library)
