"""Videos of a bright square on grey that goes where actions take it, and push files with them."""

import numpy as np

from osfcore.geometry.workspace import STEP_S
from osfcore.io.push_file import EpisodeFolder, PushEpisode, save_episode

NAMES = ("005_tomato_soup_can",)
PX_PER_M = 60.0  # at 16 pixels


def square_video(side: int, steps: int, rng: np.random.Generator) -> tuple[np.ndarray, np.ndarray]:
    """Frames (T + 1, side, side, 3) of 8 bit, and actions (T, 3)."""
    actions = np.pad(rng.uniform(-0.3, 0.3, (steps, 2)), ((0, 0), (0, 1)))
    way = np.concatenate([[[0, 0]], np.cumsum(actions[:, :2], axis=0)]) * STEP_S * PX_PER_M * side / 16
    centres = np.clip(side / 2 + way, 3, side - 3)
    frames = np.full((steps + 1, side, side, 3), 80, np.uint8)
    for frame, (x, y) in zip(frames, centres.round().astype(int), strict=True):
        frame[y - 2 : y + 2, x - 2 : x + 2] = (230, 200, 60)
    return frames, actions


def episode(side: int, steps: int, seed: int, *, with_frames: bool = True, names=NAMES) -> PushEpisode:
    frames, actions = square_video(side, steps, np.random.default_rng(seed))
    still = np.zeros((steps + 1, len(names), 3))
    turned = np.tile([1.0, 0, 0, 0], (steps + 1, len(names), 1))
    contact = np.zeros((steps, len(names)), bool)
    pusher = np.concatenate([np.zeros((1, 3)), np.cumsum(STEP_S * actions, axis=0)])
    return PushEpisode(names, seed, still, turned, pusher, actions, contact, frames=frames if with_frames else None)


def write_videos(path, side: int = 16, steps: int = 6, count: int = 14, **more):
    with EpisodeFolder(path, {}) as folder:
        for number in range(count):
            save_episode(folder.path(number), episode(side, steps, number, **more))
        folder.combine(count)
    return path
