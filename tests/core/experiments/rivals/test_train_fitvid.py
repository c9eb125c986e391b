import json
from dataclasses import replace

import numpy as np
import pytest
import torch
from safetensors.torch import load

from osfcore.errors import CorruptFile, InvalidInput
from osfcore.experiments.rivals import train_fitvid as training
from osfcore.experiments.rivals.fitvid import FitVidModel, FitVidSettings, read_fitvid
from osfcore.io.push_file import read_pushes
from osfcore.metrics.image_errors import psnr
from tests.support.errors import about
from tests.support.push_videos import write_videos

pytestmark = pytest.mark.usefixtures("one_thread")

# Training


@pytest.fixture(scope="module")
def data(tmp_path_factory):
    return write_videos(tmp_path_factory.mktemp("videos") / "videos.h5")


def config(data, folder, **changes) -> training.TrainFitVid:
    settings = {"iterations": 3, "width": 1, "batch": 2, "frames": 4, "save_every": 1, "device": "cpu"}
    return training.TrainFitVid((data,), folder / "net.safetensors", **{**settings, **changes})


def stop(settings, done) -> None:
    """Begin a training and leave it after so many steps."""
    begun = training.train_fitvid(settings)
    while next(begun).done < done:
        pass
    begun.close()


def test_a_run_writes_a_network_and_its_metrics(data, tmp_path):
    settings = config(data, tmp_path)
    steps = list(training.train_fitvid(settings))
    assert (steps[0].done, steps[-1].done, steps[-1].total) == (0, 3, 3)
    metrics = json.loads(settings.out.with_suffix(".json").read_text(), parse_constant=pytest.fail)
    assert (metrics["iterations"], metrics["episodes"], metrics["videos"]) == (3, 12, 2)
    assert metrics["command"] == settings.command
    assert metrics["bytes"] == settings.out.stat().st_size
    assert metrics["parameters"] == read_fitvid(settings.out).parameter_count
    assert metrics["horizons"]["5"]["psnr_copied"] > 10
    assert len(metrics["steps"]) == 5
    assert metrics["gradient_norm"] > 0
    assert metrics["action_effect"] is None  # nobody has given it the objects
    assert {p.name for p in tmp_path.iterdir()} == {"net.safetensors", "net.json"}  # no checkpoint is left


def test_the_command_names_what_differs_from_the_defaults(data, tmp_path):
    out = tmp_path / "net.safetensors"
    changed = training.TrainFitVid((data,), out, minutes=5.0, save_every=7, augment=False, seed=3)
    assert changed.command == (
        "osf train fitvid --data videos.h5 --out net.safetensors --minutes 5.0 --no-augment --save-every 7 --seed 3"
    )


def test_an_abandoned_run_goes_on_and_ends_as_a_whole_one(data, tmp_path):
    whole, parts = (config(data, tmp_path / name, measured=1) for name in ("whole", "parts"))
    list(training.train_fitvid(whole))
    stop(replace(parts, iterations=2), 1)  # the budget may grow
    assert not parts.out.exists()
    assert [s.done for s in training.train_fitvid(parts)][:3] == [1, 2, 3]
    a, b = (load(one.out.read_bytes()) for one in (whole, parts))
    assert all(torch.equal(a[name], b[name]) for name in a)


class Obedient:
    """Predicts that the picture is as bright as the pusher is fast, or that nothing changes."""

    settings = FitVidSettings(16)

    def __init__(self, obeys):
        self._obeys = obeys

    def predict(self, context, actions, pusher):
        speed = np.linalg.norm(actions.sum(axis=1), axis=-1) * np.sign(actions.sum(axis=(1, 2)))
        future = np.broadcast_to(context[-1], (*actions.shape[:2], *context.shape[1:]))
        return future + self._obeys * speed[:, None, None, None, None]


def test_what_actions_change_is_measured_beside_what_they_change_in_truth(library):
    ignored, obeyed = (training.action_effect(Obedient(obeys), library, library.names(), scenes=2) for obeys in (0, 1))
    assert ignored["predicted"] == 0
    assert obeyed["predicted"] == pytest.approx(2.0)  # ten actions of 0.1 m/s one way, and the other
    assert ignored["true"] == obeyed["true"] > 0.005


@pytest.mark.parametrize("damage", ["other settings", "cut short"])
def test_a_checkpoint_that_does_not_fit_is_not_gone_on_with(data, tmp_path, damage):
    settings = config(data, tmp_path)
    stop(replace(settings, seed=1) if damage == "other settings" else settings, 2)
    checkpoint = settings.out.with_suffix(".checkpoint")
    if damage == "cut short":
        checkpoint.write_bytes(checkpoint.read_bytes()[:1000])
    assert next(iter(training.train_fitvid(settings))).done == 0


def test_a_time_budget_ends(data, tmp_path):
    steps = list(training.train_fitvid(config(data, tmp_path, iterations=None, minutes=0.01)))
    assert steps[-1].done == steps[-1].total == 1


@pytest.mark.parametrize(
    ("change", "subject"),
    [
        ({"iterations": 0}, "iterations"),
        ({"frames": 8}, "frames of a window"),
        ({"precision": "float64"}, "precision"),
        ({"seed": -1}, "seed"),
        ({"device": "tpu"}, "device"),
        ({"data": ()}, "episodes"),
    ],
)
def test_bad_settings_are_refused_and_nothing_is_written(data, tmp_path, change, subject):
    with pytest.raises(InvalidInput, check=about(subject)):
        list(training.train_fitvid(replace(config(data, tmp_path), **change)))
    assert not list(tmp_path.iterdir())


def test_bad_places_and_files_are_refused(data, tmp_path):
    good = config(data, tmp_path)
    with pytest.raises(InvalidInput):
        list(training.train_fitvid(replace(good, out=tmp_path / "net.pt")))
    (tmp_path / "net.json").write_text("{}")
    with pytest.raises(InvalidInput):  # it belongs to something else
        list(training.train_fitvid(good))


# Augmentation


@pytest.mark.parametrize("seed", range(12))
def test_what_does_not_change_stays_the_same_beside_what_does(seed):
    """The left half moves in time, the right one does not."""
    video = torch.rand(4, 3, 32, 32, generator=torch.Generator().manual_seed(seed))
    video[:, :, :, 16:] = video[:1, :, :, 16:]
    (varied,) = training.augmented(video[None], np.random.default_rng(seed))
    right = varied[..., 24:]
    torch.testing.assert_close(right, right[:1].expand_as(right))


def test_videos_of_a_batch_are_varied_differently_and_stay_images():
    video = torch.rand(1, 3, 3, 16, 16, generator=torch.Generator().manual_seed(0)).expand(6, -1, -1, -1, -1)
    varied, again = (training.augmented(video, np.random.default_rng(0)) for _ in range(2))
    assert torch.equal(varied, again)
    assert all(not torch.equal(varied[0], other) for other in varied[1:])
    assert 0 <= float(varied.min()) <= float(varied.max()) <= 1


def test_nothing_moves_when_colours_change():
    """A ramp across the image stays one, whose columns are each of one colour."""
    ramp = torch.linspace(0.2, 0.8, 40).expand(1, 2, 3, 40, 40)
    for seed in range(20):
        varied = training.augmented(ramp, np.random.default_rng(seed))
        assert float(varied.diff(dim=-1).mean()) > 0
        torch.testing.assert_close(varied.diff(dim=-2), torch.zeros(1, 2, 3, 39, 40), atol=1e-5, rtol=0)


# Frame windows


def test_windows_are_stretches_of_the_episodes(data):
    episodes = read_pushes(data)
    videos = training.read_videos((data, data))
    assert (videos.side, len(videos.learned), len(videos.held_out)) == (16, 24, 4)
    some = training.windows(videos.held_out[:2], np.array([1, 2]), 3)
    for n, (number, start) in enumerate(((0, 1), (12, 2))):
        frames = episodes[number].frames[start : start + 4].transpose(0, 3, 1, 2)
        np.testing.assert_allclose(255 * some.frames[n], frames, atol=1e-4)
        np.testing.assert_allclose(some.actions[n], episodes[number].actions[start : start + 3], atol=1e-7)
        np.testing.assert_allclose(some.pushers[n], episodes[number].pusher[start : start + 4, :2], atol=1e-7)
    drawn = training.draw_windows(videos.learned, np.random.default_rng(0), 9, 6)  # the whole of them
    assert drawn.frames.shape == (9, 7, 3, 16, 16)
    whole = [torch.as_tensor(e.actions, dtype=torch.float32) for n, e in enumerate(episodes) if n % 12]
    assert all(any(torch.equal(actions, one) for one in whole) for actions in drawn.actions)
    with pytest.raises(InvalidInput, check=about("frames of a window")):
        training.draw_windows(videos.learned, np.random.default_rng(0), 1, 7)


def test_files_without_frames_and_of_other_kinds_are_refused(data, tmp_path):
    with pytest.raises(CorruptFile, check=about("no frames")):
        training.read_videos((write_videos(tmp_path / "plain.h5", count=2, with_frames=False),))
    with pytest.raises(CorruptFile, check=about("1 actions")):
        training.read_videos((write_videos(tmp_path / "short.h5", count=2, steps=1),))
    with pytest.raises(InvalidInput, check=about("sizes")):
        training.read_videos((data, write_videos(tmp_path / "large.h5", side=32, count=2)))
    (tmp_path / "text.h5").write_text("not a push file")
    with pytest.raises(CorruptFile, check=about("text.h5")):
        training.read_videos((tmp_path / "text.h5",))
    never_meet = ("005_tomato_soup_can", "010_potted_meat_can")
    for name, more in (("one", {"count": 1}), ("pair", {"names": never_meet})):
        with pytest.raises(InvalidInput, check=about("learn from")):
            training.read_videos((write_videos(tmp_path / f"{name}.h5", **more),))


# Measurement


def test_means_are_of_each_horizon_and_of_each_frames_own_psnr():
    predicted = np.tile(np.geomspace(1e-4, 1e-2, 40), (3, 1))
    report = training.VideoErrors(predicted, 10 * predicted).report()
    assert list(report["horizons"]) == ["10", "30"]
    assert len(report["steps"]) == 40
    for horizon in (10, 30):
        means = report["horizons"][str(horizon)]
        assert means["mse"] == pytest.approx(predicted[:, :horizon].mean(), abs=1e-6)
        assert means["psnr"] == pytest.approx(-10 * np.log10(predicted[:, :horizon]).mean(), abs=1e-3)
        assert means["psnr"] - means["psnr_copied"] == pytest.approx(10, abs=2e-3)


def test_predictions_are_compared_with_the_frames_after_the_context(data):
    torch.manual_seed(0)
    network = FitVidModel(FitVidSettings(side=16, width=1, features=6, hidden=8, latent=2)).eval()
    (errors,) = training.measure(network, training.read_videos((data,)).held_out)
    assert errors.predicted.shape == (2, 5)
    for row, number in enumerate((0, 12)):
        episode = read_pushes(data)[number]
        frames = episode.frames / 255
        given = episode.actions[None, 1:], episode.pusher[1]
        ours = network.predict(frames[:2], *given, between=episode.actions[0])[0]
        for step, truth in enumerate(frames[2:]):
            assert errors.predicted[row, step] == pytest.approx(((ours[step] - truth) ** 2).mean(), rel=1e-4)
            copied = -10 * np.log10(max(errors.copied[row, step], 1e-10))
            assert copied == pytest.approx(psnr(truth, frames[1]), abs=1e-3)
