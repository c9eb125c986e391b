"""The files of a data set, written as its episodes come."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np

from osfcore.errors import InvalidInput
from osfcore.export.lerobot.conventions import ACTION, ACTION_NAMES, IMAGES, STATE, STATE_NAMES, environment_names
from osfcore.export.lerobot.episode import DatasetSize, LeRobotEpisode
from osfcore.export.lerobot.statistics import Statistics, image_statistics, pooled, statistics_of
from osfcore.export.lerobot.tables import episodes_table, frames_table, parquet, tasks_table
from osfcore.export.lerobot.video import FPS, video_info, write_video
from osfcore.geometry.workspace import STEP_S
from osfcore.io.files import write_atomically, write_json

_VERSION, _ROBOT = "v3.0", "osf_tabletop"
_FILES_A_CHUNK = 1000
_FILE = "chunk-{chunk_index:03d}/file-{file_index:03d}"
_DATA, _VIDEOS = f"data/{_FILE}.parquet", f"videos/{{video_key}}/{_FILE}.mp4"
_EPISODES = f"meta/episodes/{_FILE}.parquet".format(chunk_index=0, file_index=0)
_NUMBERS: tuple[str, ...] = ("frame_index", "episode_index", "index", "task_index")
_PER_OBJECT = 14  # numbers of an environment state


class Writer:
    """A data set being written.

    Args:
        folder: for it.
    """

    def __init__(self, folder: Path) -> None:
        self._folder = folder
        self._shapes: dict[str, tuple[int, ...]] = {}
        self._rows: list[dict[str, Any]] = []
        self._statistics: list[dict[str, Statistics]] = []
        self._tasks: dict[str, int] = {}
        self._frames = 0

    def add(self, episode: LeRobotEpisode) -> None:
        """Write data and videos of an episode, and keep what the tables tell of it."""
        self._check(episode)
        count, number = len(episode.actions), len(self._rows)
        chunk, file = divmod(number, _FILES_A_CHUNK)
        place = {"chunk_index": chunk, "file_index": file}
        steps = np.arange(count)
        task = self._tasks.setdefault(episode.task, len(self._tasks))
        numbers = dict(zip(_NUMBERS, np.broadcast_arrays(steps, number, self._frames + steps, task), strict=True))
        times_s = STEP_S * steps
        data = parquet(frames_table(episode.vectors, numbers, times_s))
        write_atomically(self._folder / _DATA.format(**place), data)
        for key, images in episode.videos.items():
            write_video(self._folder / _VIDEOS.format(video_key=key, **place), images)
        plain = {**episode.vectors, **{key: one[:, None] for key, one in {"timestamp": times_s, **numbers}.items()}}
        found = {key: statistics_of(rows.astype(float)) for key, rows in plain.items()}
        found |= {key: image_statistics(images) for key, images in episode.videos.items()}
        self._statistics.append(found)
        self._rows.append(_row(episode, number, self._frames, place, found))
        self._frames += count

    def close(self) -> DatasetSize:
        """Write what is told of all."""
        if not self._rows:
            raise InvalidInput("number of episodes", 0, "at least 1")
        size = DatasetSize(len(self._rows), self._frames, len(self._tasks))
        write_atomically(self._folder / "meta/tasks.parquet", parquet(tasks_table(list(self._tasks))))
        write_atomically(self._folder / _EPISODES, parquet(episodes_table(self._rows)))
        together = {key: pooled([one[key] for one in self._statistics]) for key in self._statistics[0]}
        write_json(self._folder / "meta/stats.json", {key: _plain(found) for key, found in together.items()})
        write_json(self._folder / "meta/info.json", _info(self._shapes, size))
        return size

    def _check(self, episode: LeRobotEpisode) -> None:
        count = len(episode.actions)
        if count == 0:
            raise InvalidInput("number of actions in an episode", 0, "at least 1")
        arrays = {**episode.vectors, **episode.videos}
        uneven = [key for key, rows in arrays.items() if len(rows) != count]
        if uneven:
            raise InvalidInput(
                f"number of rows of {uneven[0]}", len(arrays[uneven[0]]), f"{count}, one for each action"
            )
        shapes = {key: rows.shape[1:] for key, rows in arrays.items()}
        odd = [shape for shape in shapes.values() if len(shape) == len("hwc") and (shape[0] % 2 or shape[1] % 2)]
        if odd:
            raise InvalidInput("size of images [px]", odd[0][:2], "even, as videos need it")
        if self._shapes and shapes != self._shapes:
            raise InvalidInput(f"what episode {len(self._rows)} tells", shapes, f"as in the first one, {self._shapes}")
        self._shapes = shapes


def _row(
    episode: LeRobotEpisode, number: int, first: int, place: Mapping[str, int], found: Mapping[str, Statistics]
) -> dict[str, Any]:
    """What the table of episodes tells of one."""
    count = len(episode.actions)
    row = {
        "episode_index": number,
        "tasks": [episode.task],
        "length": count,
        "dataset_from_index": first,
        "dataset_to_index": first + count,
        "meta/episodes/chunk_index": 0,
        "meta/episodes/file_index": 0,
        **{f"data/{key}": value for key, value in place.items()},
    }
    for key in episode.videos:
        times_s = {"from_timestamp": 0.0, "to_timestamp": count * STEP_S}
        row |= {f"videos/{key}/{name}": value for name, value in {**place, **times_s}.items()}
    return row | {f"stats/{key}/{name}": v for key, one in found.items() for name, v in _plain(one).items()}


def _plain(found: Statistics) -> dict[str, Any]:
    return {name: value.tolist() for name, value in found.items()}


def _info(shapes: Mapping[str, tuple[int, ...]], size: DatasetSize) -> dict[str, Any]:
    """What a data set tells of itself."""
    features = {key: _feature(key, shape) for key, shape in shapes.items()}
    features["timestamp"] = {"dtype": "float32", "shape": [1], "names": None}
    features |= {key: {"dtype": "int64", "shape": [1], "names": None} for key in _NUMBERS}
    return {
        "codebase_version": _VERSION,
        "robot_type": _ROBOT,
        "total_episodes": size.episodes,
        "total_frames": size.frames,
        "total_tasks": size.tasks,
        "chunks_size": _FILES_A_CHUNK,
        "data_files_size_in_mb": 100,
        "video_files_size_in_mb": 200,
        "fps": FPS,
        "splits": {"train": f"0:{size.episodes}"},
        "data_path": _DATA,
        "video_path": _VIDEOS if any(key.startswith(IMAGES) for key in shapes) else None,
        "features": features,
    }


def _feature(key: str, shape: tuple[int, ...]) -> dict[str, Any]:
    if key.startswith(IMAGES):
        names, info = ["height", "width", "channels"], video_info(*shape[:2])
        return {"dtype": "video", "shape": list(shape), "names": names, "info": info}
    names = {ACTION: ACTION_NAMES, STATE: STATE_NAMES}.get(key) or environment_names(shape[0] // _PER_OBJECT)
    return {"dtype": "float32", "shape": list(shape), "names": list(names)}
