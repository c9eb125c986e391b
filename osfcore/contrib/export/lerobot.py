"""Episodes as a data set of LeRobot, format v3.0 (as of lerobot 0.4.4), written without LeRobot."""

from __future__ import annotations

import io
import json
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
from jaxtyping import Float, UInt8

from osfcore.errors import InvalidInput
from osfcore.extras import need
from osfcore.geometry.workspace import STEP_S
from osfcore.io.files import folder_at_once, write_atomically, write_json
from osfcore.io.video_file import mp4_at_once, need_ffmpeg

# Keys and meanings of the features of a table.
#
#     action                           (2,) the pusher's velocity (vx, vy) [m/s], each within 0.3, held for 0.2 s
#     observation.state                (2,) the pusher's place [m]
#     observation.environment_state    (14 N,) poses of the N objects, then those of their goals; each is position [m]
#                                      and quaternion (w, x, y, z) with w >= 0, T_world_object
#     observation.images.camera_0 .. 3 images of the cameras, linear RGB of 8 bits; of the goal: observation.images.goal
#     task                             the task in words
#
# LeRobot's policies take `environment_state` for the truth that only a simulator knows: a data set for policies
# that look leaves it out.
#
# Layout of a data set: the format lets episodes share files; with a file for each they are written as they come, and
# can be taken out by hand.
#
#     meta/info.json, stats.json, tasks.parquet    contents; statistics of all episodes; tasks in words
#     meta/episodes/chunk-000/file-000.parquet     a row for each episode: its place, statistics
#     data/chunk-CCC/file-FFF.parquet              a row for each action
#     videos/KEY/chunk-CCC/file-FFF.mp4            images of a camera before each action

ACTION, STATE = "action", "observation.state"
ENVIRONMENT, IMAGES = "observation.environment_state", "observation.images"
GOAL_IMAGE = "goal"
FPS = round(1 / STEP_S)
_CODEC, _PIXELS = "h264", "yuv420p"
_EVERY = "2"  # every other frame stands for itself: programs that learn read frames in any order, LeRobot's choice too
_VERSION, _ROBOT = "v3.0", "osf_tabletop"
_FILES_A_CHUNK = 1000
_FILE = "chunk-{chunk_index:03d}/file-{file_index:03d}"
_DATA, _VIDEOS = f"data/{_FILE}.parquet", f"videos/{{video_key}}/{_FILE}.mp4"
_EPISODES = f"meta/episodes/{_FILE}.parquet".format(chunk_index=0, file_index=0)
_NUMBERS = ("frame_index", "episode_index", "index", "task_index")
_POSE_NAMES = ("x", "y", "z", "qw", "qx", "qy", "qz")


def environment_state(poses: Float[np.ndarray, "N 7"], goal: Float[np.ndarray, "N 7"]) -> Float[np.ndarray, "D"]:
    """Join rows of poses (`pose_rows`) of N objects and of their goals to D = 14 N numbers."""
    return np.concatenate([poses, goal]).reshape(-1)


def environment_names(objects: int) -> tuple[str, ...]:
    """Name each number of an environment state."""
    whose = [f"{what}_{number}" for what in ("object", "goal") for number in range(objects)]
    return tuple(f"{one}_{name}" for one in whose for name in _POSE_NAMES)


def image_name(camera: str) -> str:
    """Name the images of a camera "0" to "3"."""
    return f"camera_{camera}"


def instruction(names: Sequence[str], moved: Sequence[str]) -> str:
    """Say a task in words, such as "Push the gelatin box to its goal and leave the mug where it is.".

    Args:
        names: of the objects, such as "009_gelatin_box".
        moved: those that shall move; none if this is unknown.
    """
    if not moved:
        return f"Push {_listed(names)} to where the goal shows {'it' if len(names) == 1 else 'them'}."
    still = [name for name in names if name not in moved]
    words = f"Push {_listed(moved)} to {'its goal' if len(moved) == 1 else 'their goals'}"
    if still:
        words += f" and leave {_listed(still)} where {'it is' if len(still) == 1 else 'they are'}"
    return f"{words}."


def _listed(names: Sequence[str]) -> str:
    plain = [f"the {name.lstrip('0123456789_-').replace('_', ' ') or name}" for name in names]
    return " and ".join([", ".join(plain[:-1]), plain[-1]] if len(plain) > 1 else plain)


# Statistics that LeRobot normalises by: minimum, maximum, mean, standard deviation, count and quantiles.


_QUANTILES = {"q01": 0.01, "q10": 0.1, "q50": 0.5, "q90": 0.9, "q99": 0.99}
Statistics = dict[str, np.ndarray]


def statistics_of(values: Float[np.ndarray, "T D"]) -> Statistics:
    """Compute the statistics of each of D numbers over T rows."""
    moments = {name: getattr(values, name)(axis=0) for name in ("min", "max", "mean", "std")}
    quantiles = dict(zip(_QUANTILES, np.quantile(values, list(_QUANTILES.values()), axis=0), strict=True))
    return {**moments, "count": np.array([len(values)]), **quantiles}


def image_statistics(images: UInt8[np.ndarray, "T h w 3"]) -> Statistics:
    """Compute the statistics of each colour over all pixels of T images, in [0, 1], of shape (3, 1, 1).

    They come from the numbers of pixels of each of the 256 values: exactly, and in little memory.

    Deviation: LeRobot takes some of the images of more than 100, and of 300 px or more some of the pixels.
    """
    levels, found = np.arange(256) / 255, []
    for colour in range(3):
        counts = np.bincount(images[..., colour].reshape(-1), minlength=256)
        values, weights = levels[counts > 0], counts[counts > 0]
        mean = np.average(values, weights=weights)
        deviation = np.sqrt(np.average((values - mean) ** 2, weights=weights))
        quantiles = np.quantile(values, list(_QUANTILES.values()), method="inverted_cdf", weights=weights)
        found.append([values[0], values[-1], mean, deviation, *quantiles])
    names = ("min", "max", "mean", "std", *_QUANTILES)
    return {**dict(zip(names, np.transpose(found).reshape(-1, 3, 1, 1), strict=True)), "count": np.array([len(images)])}


def pooled(parts: Sequence[Statistics]) -> Statistics:
    """Pool statistics of several data sets; quantiles are means, weighted by count, as LeRobot's own are."""
    counts = np.array([part["count"][0] for part in parts])
    shares = counts / counts.sum()

    def mean_of(values: Sequence[np.ndarray]) -> np.ndarray:
        return np.tensordot(shares, np.stack(values), axes=1)

    mean = mean_of([part["mean"] for part in parts])
    variance = mean_of([part["std"] ** 2 + (part["mean"] - mean) ** 2 for part in parts])
    return {
        "min": np.min([part["min"] for part in parts], axis=0),
        "max": np.max([part["max"] for part in parts], axis=0),
        "mean": mean,
        "std": np.sqrt(variance),
        "count": np.array([counts.sum()]),
        **{key: mean_of([part[key] for part in parts]) for key in _QUANTILES},
    }


# The files of a data set.


def _write_table(path: Path, table: pa.Table) -> None:
    data = io.BytesIO()
    pq.write_table(table, data, compression="snappy")
    write_atomically(path, data.getvalue())


def _tasks_table(tasks: Sequence[str]) -> pa.Table:
    """Number the tasks.

    LeRobot reads the table with pandas and takes the words from the index, which the table's metadata name.
    """
    index = "__index_level_0__"
    table = pa.table({"task_index": pa.array(range(len(tasks)), pa.int64()), index: pa.array(tasks, pa.string())})
    number = {"name": "task_index", "field_name": "task_index", "pandas_type": "int64", "numpy_type": "int64"}
    words = {"name": None, "field_name": index, "pandas_type": "unicode", "numpy_type": "object"}
    pandas = {
        "index_columns": [index],
        "column_indexes": [],
        "columns": [{**column, "metadata": None} for column in (number, words)],
        "pandas_version": "2.2.0",
    }
    return table.replace_schema_metadata({"pandas": json.dumps(pandas)})


def _write_video(path: Path, images: UInt8[np.ndarray, "T h w 3"]) -> None:
    """Write an MP4 that can be read from any frame on, with one image for each action.

    Raises:
        CannotWrite: if it cannot be encoded or written.
    """
    height, width = images.shape[1:3]
    path.parent.mkdir(parents=True, exist_ok=True)
    with mp4_at_once(path, width, height, FPS, "-crf", "12", "-g", _EVERY, "-bf", "0") as put:
        for image in images:
            put(image)


@dataclass(frozen=True, eq=False, slots=True)
class LeRobotEpisode:
    """An episode of T actions, each with the observation before it.

    Attributes:
        task: in words.
        actions: velocities (vx, vy) [m/s].
        pusher: its places [m].
        environment: environment states; None to leave them out.
        images: linear RGB by name, such as "camera_0"; all of one size with even sides.
    """

    task: str
    actions: Float[np.ndarray, "T 2"]
    pusher: Float[np.ndarray, "T 2"]
    environment: Float[np.ndarray, "T D"] | None = None
    images: Mapping[str, UInt8[np.ndarray, "T h w 3"]] = field(default_factory=dict)

    @property
    def vectors(self) -> dict[str, np.ndarray]:
        """All but images, by key."""
        every = {ACTION: self.actions, STATE: self.pusher, ENVIRONMENT: self.environment}
        return {key: rows.astype(np.float32) for key, rows in every.items() if rows is not None}

    @property
    def videos(self) -> dict[str, np.ndarray]:
        """Images, by key."""
        return {f"{IMAGES}.{name}": images for name, images in self.images.items()}


@dataclass(frozen=True, slots=True)
class DatasetSize:
    """Numbers of episodes, frames (one for each action) and different tasks of a data set."""

    episodes: int
    frames: int
    tasks: int


class _Writer:
    """A data set being written to a folder."""

    def __init__(self, folder: Path) -> None:
        self._folder = folder
        self._shapes: dict[str, tuple[int, ...]] = {}
        self._rows: list[dict[str, Any]] = []
        self._statistics: list[dict[str, Statistics]] = []
        self._tasks: dict[str, int] = {}
        self._frames = 0

    def add(self, episode: LeRobotEpisode) -> None:
        """Write data and videos of an episode, and keep its row and statistics."""
        self._check(episode)
        count, number = len(episode.actions), len(self._rows)
        chunk, file = divmod(number, _FILES_A_CHUNK)
        place = {"chunk_index": chunk, "file_index": file}
        steps = np.arange(count)
        task = self._tasks.setdefault(episode.task, len(self._tasks))
        numbers = dict(zip(_NUMBERS, np.broadcast_arrays(steps, number, self._frames + steps, task), strict=True))
        times_s = STEP_S * steps
        columns: dict[str, Any] = {
            key: pa.FixedSizeListArray.from_arrays(pa.array(rows.reshape(-1), pa.float32()), rows.shape[1])
            for key, rows in episode.vectors.items()
        }
        columns["timestamp"] = pa.array(times_s, pa.float32())
        columns |= {key: pa.array(values, pa.int64()) for key, values in numbers.items()}
        _write_table(self._folder / _DATA.format(**place), pa.table(columns))
        for key, images in episode.videos.items():
            _write_video(self._folder / _VIDEOS.format(video_key=key, **place), images)
        plain = {**episode.vectors, **{key: one[:, None] for key, one in {"timestamp": times_s, **numbers}.items()}}
        found = {key: statistics_of(rows.astype(float)) for key, rows in plain.items()}
        found |= {key: image_statistics(images) for key, images in episode.videos.items()}
        self._statistics.append(found)
        row: dict[str, Any] = {
            "episode_index": number,
            "tasks": [episode.task],
            "length": count,
            "dataset_from_index": self._frames,
            "dataset_to_index": self._frames + count,
            "meta/episodes/chunk_index": 0,
            "meta/episodes/file_index": 0,
            **{f"data/{key}": value for key, value in place.items()},
        }
        video = {**place, "from_timestamp": 0.0, "to_timestamp": count * STEP_S}
        for key in episode.videos:
            row |= {f"videos/{key}/{name}": value for name, value in video.items()}
        row |= {f"stats/{key}/{name}": value for key, one in found.items() for name, value in _plain(one).items()}
        self._rows.append(row)
        self._frames += count

    def close(self) -> DatasetSize:
        """Write the tables, statistics and description of all episodes."""
        if not self._rows:
            raise InvalidInput("number of episodes", 0, "at least 1")
        size = DatasetSize(len(self._rows), self._frames, len(self._tasks))
        _write_table(self._folder / "meta/tasks.parquet", _tasks_table(list(self._tasks)))
        rows = pa.table({key: [row[key] for row in self._rows] for key in self._rows[0]})
        _write_table(self._folder / _EPISODES, rows)
        together = {key: pooled([one[key] for one in self._statistics]) for key in self._statistics[0]}
        write_json(self._folder / "meta/stats.json", {key: _plain(found) for key, found in together.items()})
        write_json(self._folder / "meta/info.json", _info(self._shapes, size))
        return size

    def _check(self, episode: LeRobotEpisode) -> None:
        """Refuse an episode without actions, or of another kind than the first."""
        count = len(episode.actions)
        if count == 0:
            raise InvalidInput("number of actions in an episode", 0, "at least 1")
        arrays = {**episode.vectors, **episode.videos}
        for key, rows in arrays.items():
            if len(rows) != count:
                raise InvalidInput(f"number of rows of {key}", len(rows), f"{count}, one for each action")
        for images in episode.videos.values():
            if images.shape[1] % 2 or images.shape[2] % 2:
                raise InvalidInput("size of images [px]", images.shape[1:3], "even, as videos need it")
        shapes = {key: rows.shape[1:] for key, rows in arrays.items()}
        if self._shapes and shapes != self._shapes:
            raise InvalidInput(f"what episode {len(self._rows)} holds", shapes, f"as in the first one, {self._shapes}")
        self._shapes = shapes


def _plain(found: Statistics) -> dict[str, Any]:
    return {name: value.tolist() for name, value in found.items()}


def _info(shapes: Mapping[str, tuple[int, ...]], size: DatasetSize) -> dict[str, Any]:
    """Describe a data set."""
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
    """Describe a feature of a data set, whose key says what it is."""
    if key.startswith(IMAGES):
        video = {"height": shape[0], "width": shape[1], "codec": _CODEC, "pix_fmt": _PIXELS, "is_depth_map": False}
        video |= {"fps": FPS, "channels": 3}
        info = {**{f"video.{name}": value for name, value in video.items()}, "has_audio": False}
        return {"dtype": "video", "shape": list(shape), "names": ["height", "width", "channels"], "info": info}
    names = {ACTION: ("vx", "vy"), STATE: ("pusher_x", "pusher_y")}.get(key)
    names = names or environment_names(shape[0] // (2 * len(_POSE_NAMES)))
    return {"dtype": "float32", "shape": list(shape), "names": list(names)}


def write_dataset(folder: Path, episodes: Iterable[LeRobotEpisode]) -> DatasetSize:
    """Write a data set; the folder appears only when it is whole.

    Args:
        folder: new or empty.
        episodes: of one kind; they are taken one after the other.

    Raises:
        MissingExtra: if what writes Parquet files or videos is not installed.
        InvalidInput: if there is no episode, one has no actions, or is of another kind than the first.
        CannotWrite: if the disk refuses.
    """
    need("lerobot", "A LeRobot data set")
    need_ffmpeg("A LeRobot data set")
    with folder_at_once(folder) as partial:
        writer = _Writer(partial)
        for episode in episodes:
            writer.add(episode)
        return writer.close()
