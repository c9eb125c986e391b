from dataclasses import replace

import cv2
import numpy as np
import pytest

import osfcore.experiments.estimation as module
from osfcore.experiments.estimation import (
    EstimateReport,
    bad_failure,
    frame_failure,
    track_failure,
    write_gallery,
    write_plots,
)
from osfcore.experiments.estimation_scores import refused_frame
from osfcore.experiments.estimation_tasks import KINDS, BadScore
from osfcore.inspection.contact_sheet import Comparison
from tests.core.experiments.scores import frame, report, score, track


@pytest.fixture
def shown():
    images = np.random.default_rng(0).integers(0, 256, (4, 2, 32, 32, 3), dtype=np.uint8)
    return tuple(Comparison(f"camera {k}", *pair) for k, pair in enumerate(images))


def test_there_are_curves_of_all_that_was_measured(tmp_path):
    write_plots(tmp_path / "all", report())
    names = {"errors.png", "calibration.png", "track.png", "views.png"}
    assert {path.name for path in (tmp_path / "all").iterdir()} == names
    for name in names:
        assert cv2.imread(str(tmp_path / "all" / name)).shape[0] > 200
    write_plots(tmp_path / "first", EstimateReport(report().first))
    assert {path.name for path in (tmp_path / "first").iterdir()} == {"errors.png", "calibration.png"}


def test_nothing_found_can_be_drawn_too(tmp_path):
    refused = refused_frame(("a",), "no", 0.0)
    lost = replace(track([0.0]), position_mm=(), rotation_deg=(), absent=(), seconds=(), refused="no")
    write_plots(
        tmp_path, EstimateReport((refused,), (lost,), ((refused,),), (refused,), {1: (refused,), 2: (refused,)})
    )


def test_right_and_trusted_frames_are_no_failures(shown):
    assert frame_failure("task 0", frame(score(), score()), shown) is None
    warned = frame_failure("task 0", frame(score(flagged=True)), shown)
    assert "right, flagged: it is hardly visible" in warned.lines[1]


def test_wrong_ones_without_a_warning_come_first(shown):
    told = frame_failure("task 1", frame(score(20.0, flagged=True), score(30.0, flagged=True)), shown)
    untold = frame_failure("task 2", frame(score(), score(1.0, 170.0)), shown)
    refused = frame_failure("task 3", refused_frame(("a",), "no masks", 0.0), shown)
    assert refused.badness > untold.badness > told.badness
    assert untold.lines[0].startswith("task 2, light off by 1.0 deg")
    assert "1.0 mm, 170.0 deg WRONG, unflagged" in untold.lines[2]
    assert refused.lines == ("task 3: REFUSED: no masks",)


def test_lost_tracks_tell_when_and_from_what_start(shown):
    assert track_failure("task 0", track([1.0] * 5), shown) is None
    lost = track_failure("task 0", track([1.0] * 5, [1.0, 1.0, 40.0, 40.0, 40.0], right=False), shown)
    assert lost.lines[0] == "task 0, shown at step 4"
    assert lost.lines[1] == "  b LOST at step 4: 40 mm, 0 deg, unflagged; first pose wrong"
    assert "no start" in track_failure("task 0", replace(track([1.0]), refused="no masks"), shown).lines[0]


def test_only_believed_bad_cases_are_failures(shown):
    wrong = BadScore(KINDS[3], "", "", False, (50.0, 1.0), (3.0, 4.0))
    assert bad_failure("bad case 3", wrong, shown).lines == (
        "bad case 3: black images: wrong without a warning (50 mm / 3 deg, 1 mm / 4 deg)",
    )
    for harmless in (replace(wrong, reason="too dark"), replace(wrong, refused="no"), replace(wrong, is_right=True)):
        assert bad_failure("bad case 3", harmless, shown) is None


def test_a_gallery_shows_the_worst_and_goes_when_nothing_fails(shown, tmp_path, monkeypatch):
    monkeypatch.setattr(module, "MOST_SHOWN", 2)
    path = tmp_path / "failures.png"
    failure = frame_failure("task 1", frame(score(20.0)), shown)
    write_gallery(path, [failure])
    one = cv2.imread(str(path)).shape
    write_gallery(path, [failure, None, failure, failure])
    assert cv2.imread(str(path)).shape == (2 * one[0], one[1], 3)
    write_gallery(path, [None])
    write_gallery(path, [])
    assert not path.exists()
