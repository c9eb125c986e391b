import numpy as np
import pytest
import torch

from osfcore.experiments.rivals.train_fitvid import augmented

pytestmark = pytest.mark.usefixtures("one_thread")


@pytest.mark.parametrize("seed", range(12))
def test_all_frames_of_a_video_are_varied_alike(seed):
    still = torch.rand(1, 3, 16, 16, generator=torch.Generator().manual_seed(seed))
    (varied,) = augmented(still.expand(5, -1, -1, -1)[None], np.random.default_rng(seed))
    assert varied.shape == (5, 3, 16, 16)
    for frame in varied[1:]:
        torch.testing.assert_close(frame, varied[0])


@pytest.mark.parametrize("seed", range(12))
def test_what_does_not_change_stays_the_same_beside_what_does(seed):
    """The left half moves in time, the right one does not."""
    video = torch.rand(4, 3, 32, 32, generator=torch.Generator().manual_seed(seed))
    video[:, :, :, 16:] = video[:1, :, :, 16:]
    (varied,) = augmented(video[None], np.random.default_rng(seed))
    right = varied[..., 24:]
    torch.testing.assert_close(right, right[:1].expand_as(right))


def test_videos_of_a_batch_are_varied_differently_and_stay_images():
    video = torch.rand(1, 3, 3, 16, 16, generator=torch.Generator().manual_seed(0))
    varied = augmented(video.expand(6, -1, -1, -1, -1), np.random.default_rng(0))
    assert all(not torch.equal(varied[0], other) for other in varied[1:])
    assert 0 <= float(varied.min()) <= float(varied.max()) <= 1


def test_the_same_generator_varies_in_the_same_way():
    videos = torch.rand(2, 3, 3, 16, 16)
    one, same = (augmented(videos, np.random.default_rng(3)) for _ in range(2))
    assert torch.equal(one, same)


def test_at_most_a_fifth_of_the_side_is_cropped():
    """A ramp across the image keeps four fifths of its slope at least, whatever happens to its colours."""
    ramp = torch.linspace(0.2, 0.8, 40).expand(1, 2, 3, 40, 40)
    for seed in range(20):
        varied = augmented(ramp, np.random.default_rng(seed))
        inner = varied[..., 5:-5]
        assert float(inner.diff(dim=-1).mean()) > 0
        torch.testing.assert_close(inner.diff(dim=-2), torch.zeros(1, 2, 3, 39, 30), atol=1e-5, rtol=0)
