"""Frames and actions of recorded pushes, read window by window: thousands of videos need not fit into memory."""

from __future__ import annotations

from collections.abc import Sequence
from contextlib import ExitStack
from pathlib import Path
from typing import Any, NamedTuple

import h5py
import numpy as np
from jaxtyping import Float32, Int, UInt8

from osfcore.dynamics.training.holdout import has_held_out_pair, is_for_validation
from osfcore.errors import CorruptFile, InvalidInput

LEAST_STEPS = 2  # of an episode: two frames of context, and one to predict
_ERRORS = (OSError, KeyError, TypeError, ValueError, AttributeError)


class Windows(NamedTuple):
    """B stretches of T actions.

    Attributes:
        frames: before the first and after each action.
        actions: [m/s].
    """

    frames: UInt8[np.ndarray, "B T1 h w 3"]
    actions: Float32[np.ndarray, "B T 3"]


class Video(NamedTuple):
    """An episode in its file.

    Attributes:
        path: of the file.
        group: of the episode.
        steps: its actions.
    """

    path: Path
    group: Any
    steps: int

    def read(self, start: int, steps: int) -> tuple[UInt8[np.ndarray, "T1 h w 3"], Float32[np.ndarray, "T 3"]]:
        """A stretch of the episode.

        Raises:
            CorruptFile: if it cannot be read.
        """
        try:
            frames = self.group["frames"][start : start + steps + 1]
            actions = self.group["actions"][start : start + steps]
        except _ERRORS as error:
            raise CorruptFile(self.path, f"an episode in it cannot be read ({error})") from error
        if not np.all(np.isfinite(actions)):
            raise CorruptFile(self.path, "actions of an episode are not finite")
        return frames, actions.astype(np.float32)


class VideoFiles:
    """The episodes of push files with frames, to be used as a context.

    As for dynamics, one episode in twelve of each file is held out, and so is every other one in which a pair of
    objects meets that shall not be learned from.

    Args:
        paths: of the files.

    Raises:
        CorruptFile: if one is no push file, or has no frames.
        InvalidInput: if frames differ in size between files, or nothing is left to learn from or to measure on.

    Attributes:
        side: of the frames [px].
        learned: episodes to learn from.
        held_out: episodes to measure on.
    """

    def __init__(self, paths: Sequence[Path]) -> None:
        self.learned: list[Video] = []
        self.held_out: list[Video] = []
        sizes: dict[tuple[int, ...], Path] = {}
        with ExitStack() as opened:
            for path in paths:
                self._sort(path, opened, sizes)
            if len(sizes) > 1:
                raise InvalidInput("sizes of the frames [px]", [size[:2] for size in sizes], "the same in all files")
            for what, videos in (("learn from", self.learned), ("measure on", self.held_out)):
                if not videos:
                    raise InvalidInput(f"episodes with frames to {what}", 0, "at least 1: collect more")
            self._opened = opened.pop_all()
        self.side = next(iter(sizes))[0]

    def _sort(self, path: Path, opened: ExitStack, sizes: dict[tuple[int, ...], Path]) -> None:
        try:
            file: Any = opened.enter_context(h5py.File(path))
            for number, (_, group) in enumerate(sorted(file.items())):
                if "frames" not in group:
                    raise CorruptFile(path, "it holds no frames: 'osf collect pushes --images' keeps them")
                frames, steps = group["frames"], len(group["actions"])
                _check_shapes(path, frames, group["actions"].shape)
                sizes.setdefault(frames.shape[1:], path)
                names = [name.decode() for name in group["names"][()].tolist()]
                if is_for_validation(number):
                    self.held_out.append(Video(path, group, steps))
                elif not has_held_out_pair(names):
                    self.learned.append(Video(path, group, steps))
        except _ERRORS as error:
            if isinstance(error, CorruptFile):
                raise
            raise CorruptFile(path, f"it is not a push file ({error})") from error

    def __enter__(self) -> VideoFiles:
        return self

    def __exit__(self, *error: object) -> None:
        self._opened.close()

    def drawn(self, rng: np.random.Generator, count: int, steps: int) -> Windows:
        """Random stretches of random episodes to learn from.

        Args:
            rng: draws them.
            count: of them.
            steps: actions in each.

        Raises:
            InvalidInput: if no episode is so long.
            CorruptFile: if an episode cannot be read.
        """
        long = [video for video in self.learned if video.steps >= steps]
        if not long:
            longest = max(video.steps for video in self.learned)
            raise InvalidInput("frames of a window", steps + 1, f"at most {longest + 1}, as the longest episode has")
        chosen = rng.integers(len(long), size=count)
        starts = rng.integers([long[n].steps - steps + 1 for n in chosen])
        return windows([long[n] for n in chosen], starts, steps)


def _check_shapes(path: Path, frames: Any, actions: tuple[int, ...]) -> None:  # noqa: ANN401 - h5py's dataset
    side = frames.shape[1] if frames.ndim == 4 else 0
    if frames.dtype != np.uint8 or frames.shape != (actions[0] + 1, side, side, 3):
        raise CorruptFile(path, f"its frames are {frames.dtype} of shape {frames.shape}, not square 8-bit images")
    if len(actions) != 2 or actions[1] != 3:
        raise CorruptFile(path, f"its actions have shape {actions}, not (T, 3)")
    if actions[0] < LEAST_STEPS:
        raise CorruptFile(path, f"its episodes have {actions[0]} actions, but {LEAST_STEPS} are needed to predict any")


def windows(videos: Sequence[Video], starts: Int[np.ndarray, "B"], steps: int) -> Windows:
    """Stretches of the same length.

    Args:
        videos: episodes, as often as wanted.
        starts: first action of each stretch.
        steps: actions in each.

    Raises:
        CorruptFile: if an episode cannot be read.
    """
    read = [video.read(int(start), steps) for video, start in zip(videos, starts, strict=True)]
    return Windows(np.stack([frames for frames, _ in read]), np.stack([actions for _, actions in read]))
