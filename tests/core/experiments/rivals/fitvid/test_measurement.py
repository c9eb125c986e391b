import numpy as np
import pytest
import torch

from osfcore.experiments.rivals.fitvid import FitVidModel, FitVidSettings
from osfcore.experiments.rivals.train_fitvid import VideoErrors, VideoFiles, measure
from osfcore.io.push_file import read_pushes
from osfcore.metrics.image_errors import psnr
from tests.core.experiments.rivals.fitvid.videos import write_videos

pytestmark = pytest.mark.usefixtures("one_thread")


def test_means_are_of_each_horizon_and_of_each_frames_own_psnr():
    predicted = np.tile(np.geomspace(1e-4, 1e-2, 40), (3, 1))
    report = VideoErrors(predicted, 10 * predicted).report()
    assert list(report["horizons"]) == ["10", "30"]
    assert len(report["steps"]) == 40
    for horizon in (10, 30):
        means = report["horizons"][str(horizon)]
        assert means["mse"] == pytest.approx(predicted[:, :horizon].mean(), abs=1e-6)
        assert means["psnr"] == pytest.approx(-10 * np.log10(predicted[:, :horizon]).mean(), abs=1e-3)
        assert means["psnr"] - means["psnr_copied"] == pytest.approx(10, abs=2e-3)


def test_equal_images_have_a_finite_psnr():
    report = VideoErrors(np.zeros((1, 4)), np.ones((1, 4))).report()
    assert report["horizons"]["4"] == {"mse": 0, "psnr": 100, "mse_copied": 1, "psnr_copied": 0}


def test_predictions_are_compared_with_the_frames_after_the_context(tmp_path):
    path = write_videos(tmp_path / "a.h5", steps=5)
    torch.manual_seed(0)
    network = FitVidModel(FitVidSettings(side=16, width=1, features=6, hidden=8, latent=2)).eval()
    with VideoFiles((path,)) as files:
        (errors,) = measure(network, files.held_out)
    assert errors.predicted.shape == (2, 4)
    for row, number in enumerate((0, 12)):
        episode = read_pushes(path)[number]
        frames = episode.frames / 255
        ours = network.predict(frames[:2], episode.actions[None, 1:], between=episode.actions[0])[0]
        for step in range(4):
            truth = frames[2 + step]
            assert errors.predicted[row, step] == pytest.approx(((ours[step] - truth) ** 2).mean(), rel=1e-4)
            copied = -10 * np.log10(max(errors.copied[row, step], 1e-10))
            assert copied == pytest.approx(psnr(truth, frames[1]), abs=1e-3)
