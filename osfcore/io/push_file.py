"""Episodes of pushes on disk: one file per finished episode during collection, one HDF5 file at the end."""

from __future__ import annotations

import contextlib
import glob
import json
import shutil
import zipfile
from collections.abc import Mapping
from dataclasses import dataclass, fields
from pathlib import Path
from typing import Any

import h5py
import numpy as np
from filelock import FileLock, Timeout
from jaxtyping import Bool, Float, Float32, Int, UInt8

from osfcore.errors import CorruptFile, InvalidInput
from osfcore.io.files import file_at_once, write_atomically


@dataclass(frozen=True, eq=False, slots=True)
class Disturbed:
    """W substeps from disturbed states of an episode of N objects, for learning from.

    Attributes:
        step: index of the substep in the episode; an action has M substeps.
        positions: positions of the objects before the substep [m].
        quaternions: orientations of the objects before the substep, (w, x, y, z).
        linear: velocity of each object's origin before the substep [m per substep].
        angular: angular velocity of each object before the substep [rad per substep].
        after_positions: positions after the substep [m].
        after_quaternions: orientations after the substep.
    """

    step: Int[np.ndarray, "W"]
    positions: Float32[np.ndarray, "W N 3"]
    quaternions: Float32[np.ndarray, "W N 4"]
    linear: Float32[np.ndarray, "W N 3"]
    angular: Float32[np.ndarray, "W N 3"]
    after_positions: Float32[np.ndarray, "W N 3"]
    after_quaternions: Float32[np.ndarray, "W N 4"]


@dataclass(frozen=True, eq=False, slots=True)
class PushEpisode:
    """One episode: T actions of 0.2 s, N objects.

    Attributes:
        names: names of the objects.
        seed: seed of the scene and the actions.
        positions: positions of the objects, before the first and after each action [m].
        quaternions: orientations of the objects at the same instants, (w, x, y, z).
        pusher: centre of the pusher at the same instants [m].
        actions: commanded velocities (vx, vy, 0) [m/s].
        contact: whether the pusher touched the object during the action.
        sub_positions: positions of the objects at M equally spaced instants of each action, the last its end [m]; or
            None.
        sub_quaternions: orientations of the objects at these instants, or None.
        frames: images of one camera before the first and after each action, or None.
        disturbed: outcomes of single substeps from states near the recorded ones, or None.
    """

    names: tuple[str, ...]
    seed: int
    positions: Float[np.ndarray, "T1 N 3"]
    quaternions: Float[np.ndarray, "T1 N 4"]
    pusher: Float[np.ndarray, "T1 3"]
    actions: Float[np.ndarray, "T 3"]
    contact: Bool[np.ndarray, "T N"]
    sub_positions: Float[np.ndarray, "T M N 3"] | None = None
    sub_quaternions: Float[np.ndarray, "T M N 4"] | None = None
    frames: UInt8[np.ndarray, "T1 h w 3"] | None = None
    disturbed: Disturbed | None = None


_ARRAYS = ("positions", "quaternions", "pusher", "actions", "contact")
_OPTIONAL = ("sub_positions", "sub_quaternions", "frames")
_DISTURBED = tuple(field.name for field in fields(Disturbed))
_PREFIX = "disturbed_"  # of their names on disk


class EpisodeFolder:
    """The folder of finished episodes beside the final file, with which a killed collection can continue.

    Args:
        out: the final HDF5 file.
        settings: settings that the episodes depend on. A folder with other settings is refused.

    Raises:
        InvalidInput: if the folder has other settings, or another process is collecting into it.
    """

    def __init__(self, out: Path, settings: Mapping[str, object]) -> None:
        self._out = out
        self._folder = out.with_name(out.name + ".partial")
        self._folder.mkdir(parents=True, exist_ok=True)
        self._lock = FileLock(self._folder / "lock", blocking=False, thread_local=False)
        try:
            self._lock.acquire()
        except Timeout:
            raise InvalidInput("output file", out, "one that no other collection is writing") from None
        try:
            self._adopt(settings)
        except BaseException:
            self._lock.release()
            raise

    def __enter__(self) -> EpisodeFolder:
        return self

    def __exit__(self, *error: object) -> None:
        self._lock.release()

    def _adopt(self, settings: Mapping[str, object]) -> None:
        """Clean up after a killed run, and check that it had the same settings."""
        for leftover in (*self._folder.glob(".*"), *self._out.parent.glob(f".{glob.escape(self._out.name)}.*")):
            leftover.unlink()
        text = json.dumps(dict(settings), sort_keys=True)
        path = self._folder / "settings.json"
        if not path.exists():
            write_atomically(path, text.encode())
        elif path.read_text(encoding="utf-8") != text:
            allowed = "continued with the same settings, or its folder removed"
            raise InvalidInput(f"the collection begun in {self._folder}", "made with other settings", allowed)
        self._settings = text

    def path(self, index: int) -> Path:
        """Return the path of the episode of this index."""
        return self._folder / f"{index:07d}.npz"

    def finished(self) -> frozenset[int]:
        """Return the indices of complete episodes. Damaged ones are collected again."""
        whole = set()
        for path in self._folder.glob("*.npz"):
            with contextlib.suppress(OSError, EOFError, KeyError, ValueError, zipfile.BadZipFile):  # cut short
                load_episode(path)
                whole.add(int(path.stem))
        return frozenset(whole)

    def combine(self, count: int) -> None:
        """Write episodes 0 to count - 1 into the HDF5 file, then remove the folder.

        Raises:
            CannotWrite: if the disk refuses.
        """
        with file_at_once(self._out) as partial, h5py.File(partial, "w") as file:
            file.attrs["settings"] = self._settings
            for index in range(count):
                _write_group(file.create_group(f"{index:07d}"), load_episode(self.path(index)))
        self._lock.release()  # Windows removes no file that is open
        shutil.rmtree(self._folder)


def save_episode(path: Path, episode: PushEpisode) -> None:
    """Write one episode atomically.

    Raises:
        CannotWrite: if the disk refuses.
    """
    names = np.array(episode.names)
    with file_at_once(path) as partial, partial.open("wb") as file:
        np.savez_compressed(file, allow_pickle=False, names=names, seed=episode.seed, **_arrays(episode))


def load_episode(path: Path) -> PushEpisode:
    """Read what `save_episode` wrote."""
    with path.open("rb") as file, np.load(file) as data:
        return _episode(tuple(data["names"].tolist()), int(data["seed"]), data)


def _arrays(episode: PushEpisode) -> dict[str, np.ndarray]:
    """Return all arrays that an episode has, by name."""
    found = {name: getattr(episode, name) for name in (*_ARRAYS, *_OPTIONAL)}
    if episode.disturbed is not None:
        found |= {_PREFIX + name: getattr(episode.disturbed, name) for name in _DISTURBED}
    return {name: array for name, array in found.items() if array is not None}


def read_pushes(path: Path) -> tuple[PushEpisode, ...]:
    """Return all episodes of a push file, in order.

    Raises:
        CorruptFile: if it is not a push file.
    """
    try:
        with h5py.File(path) as file:
            return tuple(_read_group(group) for _, group in sorted(file.items()))
    except FileNotFoundError:
        raise CorruptFile(path, "there is no such file") from None
    except (OSError, KeyError, TypeError, ValueError, AttributeError) as error:
        raise CorruptFile(path, f"it is not a push file ({error})") from error


def read_sound_pushes(path: Path) -> tuple[PushEpisode, ...]:
    """Return all episodes of a push file after checking every array.

    Raises:
        CorruptFile: if there are no episodes, or an array has another shape or values that are not finite.
    """
    episodes = read_pushes(path)
    if not episodes:
        raise CorruptFile(path, "it holds no episodes")
    for number, episode in enumerate(episodes):
        if episode.actions.ndim != 2:
            raise CorruptFile(path, f"actions of episode {number} have shape {episode.actions.shape}, not (T, 3)")
        arrays = _arrays(episode)
        for name, shape in _shapes(episode).items():
            array = arrays[name]
            if array.dtype.kind not in "bfiu":
                raise CorruptFile(path, f"{name} of episode {number} are not numbers")
            if array.shape != shape:
                raise CorruptFile(path, f"{name} of episode {number} has shape {array.shape}, not {shape}")
            if not np.all(np.isfinite(array)):
                raise CorruptFile(path, f"{name} of episode {number} has values that are not finite")
    return episodes


def _shapes(episode: PushEpisode) -> dict[str, tuple[int, ...]]:
    """Return the shapes that an episode's arrays must have."""
    steps, count = len(episode.actions), len(episode.names)
    shapes: dict[str, tuple[int, ...]] = {
        "positions": (steps + 1, count, 3),
        "quaternions": (steps + 1, count, 4),
        "pusher": (steps + 1, 3),
        "actions": (steps, 3),
        "contact": (steps, count),
    }
    if episode.sub_positions is not None and episode.sub_quaternions is not None:
        instants = episode.sub_positions.shape[1] if episode.sub_positions.ndim > 1 else 0
        shapes |= {"sub_positions": (steps, instants, count, 3), "sub_quaternions": (steps, instants, count, 4)}
    if episode.frames is not None:
        shapes["frames"] = (steps + 1, *episode.frames.shape[1:3], 3)
    if episode.disturbed is not None:
        rows = len(np.atleast_1d(episode.disturbed.step))
        shapes |= {_PREFIX + name: (rows, count, 4 if "quaternions" in name else 3) for name in _DISTURBED}
        shapes |= {_PREFIX + "step": (rows,)}
    return shapes


def _write_group(group: h5py.Group, episode: PushEpisode) -> None:
    group.attrs["seed"] = episode.seed
    group.create_dataset("names", data=list(episode.names), dtype=h5py.string_dtype())
    for name, array in _arrays(episode).items():
        group.create_dataset(name, data=array, compression="gzip", shuffle=True)


def _read_group(group: h5py.Group) -> PushEpisode:
    names = tuple(name.decode() for name in np.asarray(group["names"]).tolist())
    return _episode(names, int(np.asarray(group.attrs["seed"])), group)


def _episode(names: tuple[str, ...], seed: int, stored: Mapping[str, Any]) -> PushEpisode:
    """Return an episode of arrays by their names on disk."""
    arrays = {name: np.asarray(stored[name]) for name in (*_ARRAYS, *(n for n in _OPTIONAL if n in stored))}
    disturbed = None
    if _PREFIX + _DISTURBED[0] in stored:
        disturbed = Disturbed(*(np.asarray(stored[_PREFIX + name]) for name in _DISTURBED))
    return PushEpisode(names, seed, **arrays, disturbed=disturbed)
