"""The examples that come with the program: tables with goals, and their recorded stories."""

from __future__ import annotations

import contextlib
from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np

from osfcore.errors import OsfError, UnknownName
from osfcore.geometry.light import Light
from osfcore.geometry.states import shifted_poses
from osfcore.io.files import as_mapping, read_json

from ..episodes.file_names import PREPARED_FILE, TRAJECTORY_FILE
from ..processes.messages.scene_messages import SceneRecord
from ..storage.paths import static_folder
from ..storage.records import GoalRecord
from .goals import Goals
from .runner import Runner

# Six tables to begin with: objects, light, and how it should become


@dataclass(frozen=True, slots=True)
class Preset:
    """A table and its goal.

    Attributes:
        id: identifier.
        title: for people.
        text: likewise, a line.
        objects: on the table.
        seed: of where they lie.
        azimuth_deg: of the light, from +x toward +y.
        elevation_deg: of the light, above the table.
        shifts_m: objects that lie elsewhere in the goal, and how far along x and y.
        goal_angles_deg: azimuth and elevation of the light in the goal image; None for the same light.
    """

    id: str
    title: str
    text: str
    objects: tuple[str, ...]
    seed: int
    azimuth_deg: float
    elevation_deg: float
    shifts_m: Mapping[str, tuple[float, float]]
    goal_angles_deg: tuple[float, float] | None = None

    @property
    def light(self) -> Light:
        """On the table."""
        return _light(self.azimuth_deg, self.elevation_deg)

    @property
    def goal_light(self) -> Light | None:
        """In the goal image, where it is another one."""
        return None if self.goal_angles_deg is None else _light(*self.goal_angles_deg)


# Of the ten objects that are fetched by default.
PRESETS = (
    Preset("first", "First push", "Two objects, one of them in the wrong place.",
           ("006_mustard_bottle", "007_tuna_fish_can"), 11, 60, 55,
           {"006_mustard_bottle": (-0.0886, 0.0285)}),
    Preset("pair", "Both of them", "Two objects that both have to move.",
           ("003_cracker_box", "005_tomato_soup_can"), 12, 200, 50,
           {"003_cracker_box": (0.0134, 0.0976), "005_tomato_soup_can": (0.0798, 0.1213)}),
    Preset("three", "Three things", "Three objects, two in the wrong place.",
           ("006_mustard_bottle", "010_potted_meat_can", "008_pudding_box"), 13, 320, 45,
           {"008_pudding_box": (-0.0145, -0.1745), "010_potted_meat_can": (0.0755, 0.0429)}),
    Preset("low-sun", "Low sun", "Light from 15° above the table: shadows longer than the objects.",
           ("009_gelatin_box", "005_tomato_soup_can", "004_sugar_box"), 14, 120, 15,
           {"009_gelatin_box": (0.0203, -0.1412), "005_tomato_soup_can": (0.0984, -0.1046)}),
    Preset("other-light", "Another light", "The photo was taken under a lamp from the other side.",
           ("004_sugar_box", "009_gelatin_box", "006_mustard_bottle"), 15, 40, 30,
           {"009_gelatin_box": (0.0183, -0.0797), "006_mustard_bottle": (-0.0692, 0.103)}, (220, 30)),
    Preset("four", "Four at once", "Four objects close together, two in the wrong place.",
           ("003_cracker_box", "005_tomato_soup_can", "010_potted_meat_can", "006_mustard_bottle"), 16, 280, 35,
           {"003_cracker_box": (0.0532, 0.1033), "006_mustard_bottle": (-0.0963, -0.0301)}),
)  # fmt: skip


OPENING = "three"  # with which the page opens, as a story and as the first table of a new service
_SAME_RAD = 1e-6


def preset(name: str) -> Preset:
    """One of them.

    Raises:
        UnknownName: if there is none.
    """
    for one in PRESETS:
        if one.id == name:
            return one
    raise UnknownName("preset", name[:80], [one.id for one in PRESETS])


def set_up(chosen: Preset, runner: Runner, goals: Goals) -> tuple[SceneRecord, GoalRecord]:
    """Make a preset's table and its goal, or put back those that there are, and show them.

    Args:
        chosen: the preset.
        runner: takes the scene.
        goals: take the goal.

    Raises:
        OsfError: if an object is not on this machine, or there are too many scenes or goals; then neither is left.
    """
    for made in goals.all():
        if made.example == chosen.id and made.scene:
            with contextlib.suppress(OsfError):  # held, or deleted: then another one
                if runner.jobs.needs(made.scene) is None:
                    runner.scenes.reset(made.scene)
                    return runner.scenes.activate(made.scene), made
    # Shown when all is there: the pages ask for its images then, and the goal's would wait behind them.
    there = _untouched(chosen, runner)
    scene = there or runner.scenes.create(names=chosen.objects, seed=chosen.seed, light=chosen.light, is_shown=False)
    try:
        poses = tuple(shifted_poses(scene.state, chosen.shifts_m).items())
        goal = goals.compose(scene.id, poses, chosen.title, chosen.goal_light, chosen.id)
    except BaseException:
        if there is None:
            runner.delete_scene(scene.id)
        raise
    return runner.scenes.activate(scene.id), goal


def _untouched(chosen: Preset, runner: Runner) -> SceneRecord | None:
    """The table of a preset that is there already, such as that of a new service, if nobody has changed it."""
    for scene in runner.scenes.all():
        is_same = (scene.seed, scene.state.names, scene.revision) == (chosen.seed, chosen.objects, 1)
        if is_same and scene.state.light.angle_to(chosen.light) < _SAME_RAD and runner.jobs.needs(scene.id) is None:
            return scene
    return None


def _light(azimuth_deg: float, elevation_deg: float) -> Light:
    return Light.from_angles(float(np.deg2rad(azimuth_deg)), float(np.deg2rad(elevation_deg)))


# Stories: recorded episodes of the examples that come with the program, to be watched before anything is run


STORY_FILE = "story.json"


@dataclass(frozen=True, slots=True)
class Stories:
    """The stories in a folder.

    Attributes:
        root: the folder.
    """

    root: Path = field(default_factory=lambda: static_folder() / "stories")

    def names(self) -> tuple[str, ...]:
        """Those that there are, sorted."""
        return tuple(sorted(path.parent.name for path in self.root.glob(f"*/{STORY_FILE}")))

    def trajectory(self, name: str) -> Path:
        """The file with the course of a story.

        Raises:
            UnknownName: if there is none of this name.
        """
        return self._folder(name) / TRAJECTORY_FILE

    def prepared(self, name: str) -> Path | None:
        """The file with what was found out beforehand about an example; None if there is none."""
        path = self.root / name / PREPARED_FILE
        return path if name in self.names() and path.is_file() else None

    def shown(self, name: str) -> dict[str, Any]:
        """Return what the page shows of a story.

        Raises:
            UnknownName: if there is none of this name.
            CorruptFile: if the file is damaged.
        """
        return read_json(self._folder(name) / STORY_FILE, as_mapping)

    def _folder(self, name: str) -> Path:
        if name not in self.names():
            raise UnknownName("story", name[:80], self.names())
        return self.root / name
