"""What becomes of a photographed table: a table of the simulation, or a goal of one; and how it looks when drawn."""

from __future__ import annotations

import contextlib
import uuid
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import cv2
import numpy as np

from app.processes.client import ProcessClient
from app.processes.messages.neural_messages import DrawPhoto
from app.processes.messages.scene_messages import ComposeGoal, SceneRecord
from app.services.goals.goals import Goals
from app.services.photos.table_photos import TablePhotos
from app.services.runner import Runner
from app.storage.photos import GOAL_SIDE
from app.storage.records import GoalRecord, Poses, TablePhoto
from osfcore.errors import NoRoom, OsfError
from osfcore.geometry.poses import Pose, rotation_angle
from osfcore.geometry.states import SceneState
from osfcore.io.image_file import encode_png
from osfcore.photo.table_layout import TableLayout, layout_of

_DRAWN_SIDE = 640  # [px]
_STAYED_M, _STAYED_RAD = 0.02, np.deg2rad(20.0)  # by which an object may move when it is let go where it was found


class PhotoDoubtful(OsfError):
    """A photograph in which something was not found for certain."""

    def __init__(self, doubts: Sequence[str]) -> None:
        super().__init__(f"{' '.join(doubts)} Nothing was changed; choose a picture of each, or mark it anew.")


@dataclass(frozen=True, eq=False, slots=True)
class TableMade:
    """A table that was made of a photograph.

    Attributes:
        scene: the table.
        notes: sentences about what does not lie as in the photo.
    """

    scene: SceneRecord
    notes: tuple[str, ...]


@dataclass(frozen=True, eq=False, slots=True)
class GoalMade(TableMade):
    """A goal that was made of a photograph, and the table that it is for.

    Attributes:
        goal: the goal.
    """

    goal: GoalRecord


class PhotoTables:
    """Makes tables and goals of photographs. Methods block; any thread may call.

    Args:
        runner: makes tables.
        photos: tells what was found.
        goals: keeps goals.
        link: to the process that renders fields.
    """

    def __init__(self, runner: Runner, photos: TablePhotos, goals: Goals, link: ProcessClient) -> None:
        self._runner, self._photos, self._goals, self._link = runner, photos, goals, link

    def make_table(self, photo: str, *, despite_doubts: bool = False) -> TableMade:
        """A new table whose objects lie as in a photograph, under its lamp.

        Raises:
            UnknownName: if there is no such photo.
            NotFoundYet, NoPhotographedTable, PhotoDoubtful: if it is not known how they lie.
            InvalidInput: if they lie too far apart.
            TooManyScenes, MissingAssets, OsfError: as tables are made.
        """
        record = self._photos.get(photo)
        layout = self._layout(record, despite_doubts=despite_doubts)
        scene = self._runner.create_scene(poses=tuple(layout.poses.items()), light=layout.light, is_measured=True)
        place = layout.T_table_photo
        self._photos.change(photo, lambda latest: replace(latest, scene=scene.id, T_table_photo=place))
        return TableMade(scene, _moved(layout.poses, scene.initial))

    def make_goal(self, photo: str, scene: str | None = None, *, despite_doubts: bool = False) -> GoalMade:
        """A goal in which objects lie as in a photograph.

        Args:
            photo: identifier.
            scene: that the goal is for; None for the current one if it holds the photo's objects, else a new one with
                these, lying as in the photo but in other places.
            despite_doubts: whether what was not found for certain counts all the same.

        Raises:
            UnknownName: if there is no such photo or scene, or the scene lacks one of its objects.
            NotFoundYet, NoPhotographedTable, PhotoDoubtful: if it is not known how they lie.
            InvalidInput: if they lie too far apart.
            SceneHeld, TooManyScenes, TooManyGoals, OsfError: as tables and goals are made.
        """
        record = self._photos.get(photo)
        found = self._photos.found(record)
        home = self._home(scene, {each.name for each in found.objects})
        layout = self._layout(record, None if home is None else home.id, despite_doubts=despite_doubts)
        camera = record.camera(layout.T_table_camera, GOAL_SIDE)
        png = self._reduced(record, camera.width, camera.height)
        table = home or self._elsewhere(layout)
        try:
            made = self._runner.compose(ComposeGoal(table.id, tuple(layout.poses.items()), is_measured=True))
            goal = self._goals.keep_photographed(record.name, table.id, camera, made.poses, png)
        except OsfError:
            if home is None:
                self._runner.delete_scene(table.id)
            raise
        if home is None:
            self._runner.activate(table.id)
        return GoalMade(table, _moved(layout.poses, dict(made.poses)), goal)

    def drawing(self, photo: str) -> bytes:
        """PNG of how the found scene looks from the photograph's camera, with its shadows.

        Raises:
            UnknownName: if there is no such photo.
            NotFoundYet, NoPhotographedTable: if it is not known how the objects lie.
            ProcessUnavailable: if what renders died.
        """
        record = self._photos.get(photo)
        layout = layout_of(self._photos.found(record), _choices(record))
        state = SceneState(tuple(layout.poses), Pose.stacked(layout.poses.values()), layout.light, None)
        camera = record.camera(layout.T_table_camera, _DRAWN_SIDE)
        masks = tuple(self._photos.read(self._photos.mask(photo, entry.name), photo) for entry in record.objects)
        picture = self._photos.read(self._photos.picture(photo), photo)
        return self._link.call(DrawPhoto(uuid.uuid4().hex, state, camera, picture, masks))

    def _layout(self, record: TablePhoto, scene: str | None = None, *, despite_doubts: bool) -> TableLayout:
        found = self._photos.found(record)
        if not despite_doubts and (doubts := self._photos.doubts(record, found)):
            raise PhotoDoubtful(doubts)
        shared = self._shared_frame(record, scene) if found.table == "board" else None
        return layout_of(found, _choices(record), shared)

    def _shared_frame(self, record: TablePhoto, scene: str | None) -> Pose | None:
        """Where the board lies on a table that was made of another photograph of it; None if that cannot be told."""
        for other in (record, *self._photos.all()):
            if scene is not None and other.scene == scene and other.T_world_camera is not None:
                return other.T_table_photo
        return None

    def _home(self, scene: str | None, names: set[str]) -> SceneRecord | None:
        """The table that was asked for, else the current one if it holds the objects; None if there is none."""
        if scene is not None:
            return self._runner.scene(scene)
        current = None if self._runner.current is None else self._runner.scene(self._runner.current)
        return current if current is not None and set(current.state.names) == names else None

    def _elsewhere(self, layout: TableLayout) -> SceneRecord:
        """A new table, not shown yet, whose objects lie on the same sides as in the photo, but in other places."""
        poses = tuple(layout.poses.items())
        draft = self._runner.create_scene(poses=poses, light=layout.light, is_measured=True, is_shown=False)
        try:
            start = self._shifted(draft)
        finally:
            self._runner.delete_scene(draft.id)
        return self._runner.create_scene(poses=start, light=layout.light, seed=draft.seed, is_shown=False)

    def _shifted(self, draft: SceneRecord) -> Poses:
        """A random layout: all objects shifted, or as many as there is room for."""
        with contextlib.suppress(NoRoom):
            count = len(draft.state.names)
            return self._runner.compose(ComposeGoal(draft.id, seed=draft.seed, moved=count)).poses
        return self._runner.compose(ComposeGoal(draft.id, seed=draft.seed)).poses

    def _reduced(self, record: TablePhoto, width: int, height: int) -> bytes:
        jpeg = self._photos.read(self._photos.picture(record.id), record.id)
        pixels = cv2.imdecode(np.frombuffer(jpeg, np.uint8), cv2.IMREAD_COLOR)
        assert pixels is not None, "it was encoded here"
        return encode_png(cv2.resize(pixels, (width, height), interpolation=cv2.INTER_AREA)[..., ::-1])


def _choices(record: TablePhoto) -> dict[str, int]:
    return {entry.name: entry.choice or 0 for entry in record.objects}


def _moved(asked: Mapping[str, Pose], rests: SceneState | Mapping[str, Pose]) -> tuple[str, ...]:
    """A sentence for each object that did not stay where it was found."""
    notes = []
    for name, pose in asked.items():
        there = rests.pose(name) if isinstance(rests, SceneState) else rests[name]
        shift = float(np.linalg.norm((there.position - pose.position)[:2]))
        if shift > _STAYED_M:
            notes.append(f"{name} did not stay where the photo shows it: it moved by {100 * shift:.0f} cm.")
        elif (turn := float(rotation_angle(there.quaternion, pose.quaternion))) > _STAYED_RAD:
            turned = f"it turned by {np.rad2deg(turn):.0f} degrees"
            notes.append(f"{name} did not stay as the photo shows it: {turned} when it was let go.")
    return tuple(notes)
