"""Video prediction: video prediction, video episodes."""

import json
from contextlib import contextmanager
from dataclasses import replace

import cv2
import numpy as np
import pytest

import osfcore.experiments.estimation_tasks as tasks
import osfcore.experiments.video_prediction as videos
from osfcore.control.estimators import Estimators, load_scene_models
from osfcore.errors import CorruptFile, InvalidInput
from osfcore.experiments.rearrangement_runs import TrueEstimators
from osfcore.experiments.rivals.fitvid import FitVidModel, FitVidSettings, write_fitvid
from osfcore.experiments.video_prediction import (
    CHART_FILE,
    IMAGES_FILE,
    REPORT_FILE,
    CompareVideos,
    VideoEpisodes,
    compare_videos,
    predict_through_fields,
    simulate_video,
)
from osfcore.fields.field_library import FieldLibrary
from osfcore.geometry.cameras import goal_camera
from osfcore.metrics.image_errors import psnr
from osfcore.random_streams import Stream
from osfcore.world.tasks import draw_scene
from tests.core.experiments.nerfs import write_nerfs
from tests.core.experiments.solids import SOLIDS

# Video prediction


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


@pytest.mark.usefixtures("one_thread")
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


@pytest.mark.usefixtures("one_thread")
@pytest.mark.slow
def test_pictures_show_the_first_episode(compared):
    asked, _ = compared
    image = cv2.imread(str(asked.folder / IMAGES_FILE))
    assert image is not None
    assert image.shape[0] > 6 * 16  # simulator and methods
    assert image.shape[1] > 2 * 16  # steps 1 and 10
    assert (asked.folder / CHART_FILE).exists()


@pytest.mark.usefixtures("one_thread")
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


@pytest.mark.usefixtures("one_thread")
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


@pytest.mark.usefixtures("one_thread")
def test_a_broken_network_is_told(library, tmp_path):
    write_weights(tmp_path)
    (tmp_path / "data" / "fitvid.safetensors").write_bytes(b"broken")
    with pytest.raises(CorruptFile, match="fitvid"):
        report_of(config(tmp_path), library)


# Video episodes


STEPS, SIZE = 3, 48
DRAW = draw_scene(SOLIDS, 2, 3, 0, Stream.VIDEO_SCENE)


@pytest.fixture(scope="module")
def video(library):
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(tasks, "PUSHED_M", 0.0)  # few steps push nothing far
        yield simulate_video(DRAW, library, STEPS, SIZE)


@pytest.fixture
def episodes(library, tmp_path):
    return VideoEpisodes(FieldLibrary(None), library, tmp_path, 0, STEPS, SIZE)


@contextmanager
def at_rest(library):
    with tasks.opened(DRAW, library) as world:
        world.restore(world.truth())
        yield world


@pytest.mark.usefixtures("one_thread")
def test_the_actions_lead_from_each_frame_to_the_next(video, library):
    camera = (goal_camera(SIZE),)
    assert video.frames.shape == (STEPS, SIZE, SIZE, 3)
    assert video.actions.shape == (STEPS, 3)
    with at_rest(library) as world:
        seen = [world.render(camera).images[0]]
        for action in (video.between, *video.actions):
            world.act(action)
            seen.append(world.render(camera).images[0])
    np.testing.assert_allclose(np.concatenate([video.context, video.frames]), seen, atol=1e-4)


@pytest.mark.usefixtures("one_thread")
def test_the_look_has_four_views_with_masks_at_the_last_known_frame(video, library):
    assert [camera.name for camera in video.look.cameras] == ["0", "1", "2", "3"]
    with at_rest(library) as world:
        world.act(video.between)
        observation = world.render(video.look.cameras, masks=True)
    np.testing.assert_allclose(video.look.images, observation.images, atol=1e-4)
    np.testing.assert_array_equal(video.look.masks, observation.masks)
    np.testing.assert_array_equal(video.look.pusher, observation.pusher)


@pytest.mark.usefixtures("one_thread")
def test_a_copy_of_a_scene_in_which_nothing_moves_is_perfect(video, episodes, monkeypatch):
    still = replace(video, frames=np.repeat(video.context[1:], STEPS, axis=0))
    monkeypatch.setattr(videos, "simulate_video", lambda *_: still)
    result = episodes.measure(0, DRAW, "copied")
    assert (result.figures["mse"], result.figures["psnr"]) == ([0] * STEPS, [100] * STEPS)
    np.testing.assert_allclose(result.figures["ssim"], 1, atol=1e-12)
    assert [shown.label for shown in result.shown] == ["step 1"]


@pytest.mark.usefixtures("one_thread")
def test_figures_are_of_each_step(video, episodes, monkeypatch):
    offsets = np.array([0.1, 0.01, 0.2]).reshape(-1, 1, 1, 1)
    grey = np.full_like(video.context, 0.5)
    moved = replace(video, context=grey, frames=grey[:1] + offsets)
    monkeypatch.setattr(videos, "simulate_video", lambda *_: moved)
    figures = episodes.measure(0, DRAW, "copied").figures
    np.testing.assert_allclose(figures["mse"], [0.01, 0.0001, 0.04], rtol=1e-5)
    np.testing.assert_allclose(figures["psnr"], -10 * np.log10(figures["mse"]), atol=1e-6)


@pytest.mark.usefixtures("one_thread")
def test_told_the_true_state_our_prediction_is_better_than_a_copy(video, library):
    names = video.look.names
    models = load_scene_models(names, FieldLibrary(None), library, None)
    with at_rest(library) as world:
        world.act(video.between)
        start = world.truth()
    told = TrueEstimators(truth=lambda: start)
    rng = np.random.default_rng(0)
    predicted = predict_through_fields(video, models, told, goal_camera(SIZE), rng)
    assert predicted.shape == video.frames.shape
    ours = [psnr(true, image) for true, image in zip(video.frames, predicted, strict=True)]
    copied = [psnr(true, video.context[1]) for true in video.frames]
    assert min(ours) > 26
    assert ours[-1] > copied[-1] + 3
    still = predict_through_fields(
        replace(video, actions=np.zeros((2, 3))), models, told, goal_camera(SIZE), rng
    )  # fmt: skip
    np.testing.assert_allclose(still[0], still[1], atol=1e-6)


@pytest.mark.usefixtures("one_thread")
def test_video_prediction_sees_two_frames_and_the_actions(video, episodes, monkeypatch, tmp_path):
    network = FitVidModel(FitVidSettings(64, 1, 2, 2, 1)).eval()
    write_fitvid(tmp_path / "fitvid.safetensors", network)
    larger = replace(
        video, context=np.zeros((2, 64, 64, 3), np.float32), frames=np.zeros((STEPS, 64, 64, 3), np.float32)
    )  # fmt: skip
    monkeypatch.setattr(videos, "simulate_video", lambda *_: larger)
    asked, real = [], FitVidModel.predict

    def predict(self, context, actions, *, between):
        asked.append((context, actions, between))
        return real(self, context, actions, between=between)

    monkeypatch.setattr(FitVidModel, "predict", predict)
    result = replace(episodes, size=64).measure(0, DRAW, "fitvid")
    ((context, actions, between),) = asked
    np.testing.assert_array_equal(context, larger.context)
    np.testing.assert_array_equal(actions, video.actions[None])
    np.testing.assert_array_equal(between, video.between)
    assert len(result.figures["psnr"]) == STEPS


@pytest.mark.usefixtures("one_thread")
def test_all_methods_estimate_with_the_same_random_numbers(video, episodes, monkeypatch):
    monkeypatch.setattr(videos, "simulate_video", lambda *_: video)
    drawn = []

    def predict(_video, models, estimators, camera, rng):
        drawn.append((type(models.dynamics).__name__, type(estimators), camera.width, rng.random()))
        return video.frames

    monkeypatch.setattr(videos, "predict_through_fields", predict)
    for method in ("ours", "paper"):
        assert episodes.measure(4, DRAW, method).figures["psnr"] == [100] * STEPS
    (ours, theirs) = drawn
    assert ours[1] is Estimators
    assert theirs[1] is not Estimators
    assert ours[0] != theirs[0]
    assert ours[2:] == theirs[2:]
    episodes.measure(5, DRAW, "ours")
    assert drawn[2][3] != ours[3]
