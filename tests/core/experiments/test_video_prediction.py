import json
from dataclasses import replace

import cv2
import numpy as np
import pytest

import osfcore.experiments.estimation_tasks as tasks
import osfcore.experiments.video_prediction as videos
from osfcore.control.estimators import load_scene_models
from osfcore.errors import InvalidInput
from osfcore.experiments.rearrangement_runs import TrueEstimators
from osfcore.experiments.rivals.fitvid import FitVidModel, FitVidSettings, read_fitvid, write_fitvid
from osfcore.fields.field_library import FieldLibrary
from osfcore.geometry.cameras import default_cameras, goal_camera
from osfcore.metrics.image_errors import psnr
from osfcore.random_streams import Stream
from osfcore.world.tasks import draw_scene
from tests.support.errors import about
from tests.support.solids import SOLIDS, write_nerfs

pytestmark = pytest.mark.usefixtures("one_thread")

# Comparisons


def config(folder, **changes) -> videos.CompareVideos:
    given = videos.CompareVideos(folder / "out", folder / "data", SOLIDS, tasks=1, objects=2, steps=12, size=16)
    return replace(given, **changes)


def report_of(asked, library):
    *_, last = videos.compare_videos(asked, FieldLibrary(None), library)
    return last.report


def write_weights(folder):
    write_nerfs(folder / "data")
    write_fitvid(folder / "data" / "fitvid.safetensors", FitVidModel(FitVidSettings(16, 1, 2, 2, 1)).eval())


def predict_grey(patch):
    """Let grey take the place of predictions that take long; few steps push nothing far."""
    patch.setattr(tasks, "PUSHED_M", 0.0)
    patch.setattr(videos, "predict_through_fields", lambda video, *_: np.full_like(video.frames, 0.5))


@pytest.fixture(scope="module")
def compared(library, tmp_path_factory):
    folder = tmp_path_factory.mktemp("video")
    write_weights(folder)
    asked = config(folder)
    with pytest.MonkeyPatch.context() as patch:
        predict_grey(patch)
        steps = list(videos.compare_videos(asked, FieldLibrary(None), library))
    return asked, steps


@pytest.mark.slow
def test_an_episode_is_predicted_by_all_methods(compared):
    asked, steps = compared
    assert [(step.done, step.total) for step in steps] == [(n, 5) for n in range(6)]
    report = steps[-1].report
    assert json.loads((asked.folder / videos.REPORT_FILE).read_text()) == report
    assert list(report["methods"]) == ["copied", "ours", "paper", "nerf", "fitvid"]
    for figures in report["methods"].values():
        for row in figures.values():
            assert len(row["along"]) == 12
            assert set(row["spans"]) == {"10", "12"}
            assert row["spans"]["10"]["mean"] == pytest.approx(np.mean(row["along"][:10]), rel=1e-4)
    assert report["methods"]["ours"] == report["methods"]["paper"] == report["methods"]["nerf"]
    ours, copied = (report["methods"][who]["mse"]["spans"]["12"]["mean"] for who in ("ours", "copied"))
    assert report["against"]["copied"]["mse"]["12"]["difference"] == pytest.approx(ours - copied, abs=1e-6)
    image = cv2.imread(str(asked.folder / videos.IMAGES_FILE))
    assert image.shape[0] > 6 * 16  # simulator and methods
    assert image.shape[1] > 2 * 16  # steps 1 and 10
    assert (asked.folder / videos.CHART_FILE).exists()


@pytest.mark.slow
def test_what_was_predicted_is_taken_over_method_by_method(compared, library, monkeypatch):
    predict_grey(monkeypatch)
    asked, steps = compared
    measured, real = [], videos.simulate_video
    monkeypatch.setattr(videos, "simulate_video", lambda *given: measured.append(given) or real(*given))
    assert report_of(asked, library) == steps[-1].report
    assert report_of(replace(asked, methods=("ours",)), library)["against"] == {}
    assert measured == []
    write_fitvid(asked.data_dir / "fitvid.safetensors", FitVidModel(FitVidSettings(16, 1, 2, 3, 1)).eval())
    report = report_of(replace(asked, size=32), library)  # the network's side counts
    assert report["size"] == 16
    assert len(measured) == 1  # of the network that is another one


@pytest.mark.parametrize(
    ("changes", "subject"),
    [({"objects": 4}, "number of objects"), ({"steps": 500}, "steps"), ({"methods": ()}, "methods")],
)
def test_a_mistake_is_found_before_anything_is_written(library, tmp_path, changes, subject):
    write_weights(tmp_path)
    with pytest.raises(InvalidInput, check=about(subject)):
        report_of(config(tmp_path, **changes), library)
    assert not (tmp_path / "out").exists()


# Episodes


STEPS, SIZE = 3, 48
DRAW = draw_scene(SOLIDS, 2, 3, 0, Stream.VIDEO_SCENE)


@pytest.fixture(scope="module")
def video(library):
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(tasks, "PUSHED_M", 0.0)  # few steps push nothing far
        return videos.simulate_video(DRAW, library, STEPS, SIZE)


@pytest.fixture
def measure(library, tmp_path):
    """Measures an episode as a method predicts it."""

    def measure(method, size=SIZE):
        asked = videos.CompareVideos(tmp_path, tmp_path, steps=STEPS, size=size)
        return videos.measure_video(asked, FieldLibrary(None), library, 0, DRAW, method)

    return measure


def test_the_actions_lead_from_each_frame_to_the_next(video, library):
    camera = (goal_camera(SIZE),)
    assert video.frames.shape == (STEPS, SIZE, SIZE, 3)
    with tasks.opened(DRAW, library) as world:
        world.restore(world.truth())
        seen = [world.render(camera).images[0]]
        for action in (video.between, *video.actions):
            world.act(action)
            seen.append(world.render(camera).images[0])
            if len(seen) == 2:  # the look has four views with masks at the last known frame
                look = world.render(default_cameras(), masks=True)
    np.testing.assert_allclose(np.concatenate([video.context, video.frames]), seen, atol=1e-4)
    np.testing.assert_allclose(video.look.images, look.images, atol=1e-4)
    np.testing.assert_array_equal(video.look.masks, look.masks)
    np.testing.assert_array_equal(video.look.pusher, look.pusher)


def test_figures_are_of_each_step(video, measure, monkeypatch):
    offsets = np.array([0.1, 0.0, 0.2]).reshape(-1, 1, 1, 1)
    moved = replace(video, frames=video.context[1] + offsets)
    monkeypatch.setattr(videos, "simulate_video", lambda *_: moved)
    result = measure("copied")
    np.testing.assert_allclose(result.figures["mse"], [0.01, 0, 0.04], rtol=1e-4, atol=1e-12)
    np.testing.assert_allclose(result.figures["psnr"], [20, 100, -10 * np.log10(0.04)], atol=1e-3)
    assert result.figures["ssim"][1] == pytest.approx(1)
    assert [shown.label for shown in result.shown] == ["step 1"]


def test_with_the_true_state_our_prediction_is_better_than_a_copy(video, library):
    models = load_scene_models(video.look.names, FieldLibrary(None), library, None)
    with tasks.opened(DRAW, library) as world:
        world.restore(world.truth())
        world.act(video.between)
        start = world.truth()
    exact = TrueEstimators(truth=lambda: start)
    predicted = videos.predict_through_fields(video, models, exact, goal_camera(SIZE), np.random.default_rng(0))
    assert predicted.shape == video.frames.shape
    ours = [psnr(true, image) for true, image in zip(video.frames, predicted, strict=True)]
    copied = [psnr(true, video.context[1]) for true in video.frames]
    assert min(ours) > 26
    assert ours[-1] > copied[-1] + 3


def test_fitvid_sees_two_frames_and_the_actions(video, measure, monkeypatch, tmp_path):
    write_fitvid(tmp_path / "fitvid.safetensors", FitVidModel(FitVidSettings(64, 1, 2, 2, 1)).eval())
    rng = np.random.default_rng(0)
    context, frames = rng.random((2, 64, 64, 3)), rng.random((STEPS, 64, 64, 3))
    monkeypatch.setattr(videos, "simulate_video", lambda *_: replace(video, context=context, frames=frames))
    network = read_fitvid(tmp_path / "fitvid.safetensors")
    expected = network.predict(context, video.actions[None], video.look.pusher, between=video.between)[0]
    found = measure("fitvid", size=64).figures["psnr"]
    assert found == pytest.approx([psnr(true, image) for true, image in zip(frames, expected, strict=True)])
