"""Photographs of tables: what is marked in them, what is found, and what becomes of it."""

from __future__ import annotations

import contextlib
import threading
import uuid
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import cv2
import numpy as np

from osfcore.errors import CorruptFile, InvalidInput, NoRoom, NotThere, OsfError, UnknownName, check_known, check_seed
from osfcore.geometry.cameras import Camera
from osfcore.geometry.poses import Pose, rotation_angle
from osfcore.geometry.states import MAX_OBJECTS, SceneState
from osfcore.io.files import read_json
from osfcore.io.image_file import encode_png
from osfcore.io.json_codec import decode
from osfcore.photo.board import Board, board_of
from osfcore.photo.calibration import Calibration, Sighting
from osfcore.photo.camera_files import KnownCamera
from osfcore.photo.found_scene import FoundScene
from osfcore.photo.photograph import check_shared
from osfcore.photo.table_layout import TableLayout, layout_of

from ..jobs.job import Job
from ..jobs.kinds.photos import FOUND, PhotoInput, PhotoParams, inputs_of
from ..processes.client import ProcessClient, ProcessHangs
from ..processes.messages.neural_messages import DrawPhoto
from ..processes.messages.photo_messages import (
    AssessCamera,
    FindMask,
    Mark,
    MaskFound,
    PhotoAnswer,
    PhotoOrder,
    PhotoRead,
    ReadPhoto,
    SightBoard,
)
from ..processes.messages.scene_messages import ComposeGoal, SceneRecord
from ..processes.photo_process import PhotoRefused, photo_main
from ..storage.database import now_utc
from ..storage.photos import GOAL_SIDE
from ..storage.records import (
    PICTURE,
    STRAIGHT,
    Files,
    GoalRecord,
    MarkedObject,
    Poses,
    TablePhoto,
    TablePhotoStore,
    mask_file,
)
from .fields import FieldCatalogue
from .goals import Goals
from .runner import Runner, fill_inputs

# Photographs of tables: taken in, marked by a person, and looked at by a job (`app.jobs.kinds.photos`)


KIND = "photo"


class NothingMarked(OsfError):
    """A photograph in which no object was marked."""

    def __init__(self) -> None:
        super().__init__("No object is marked in this photo yet; name one and draw a box around it.")


class NotFoundYet(OsfError):
    """A photograph whose objects have not been found, or no longer since something else is marked."""

    def __init__(self) -> None:
        super().__init__("The objects of this photo have not been found yet; press Find, and wait for the end.")


@dataclass(frozen=True, slots=True)
class PhotosChanged:
    """A photograph is another one now, came or went."""


class TablePhotos(TablePhotoStore):
    """The photographs of one service. Methods that change something block; any thread may call.

    Args:
        runner: does the jobs, and publishes what has changed.
        fields: what can be recognised.
        data_dir: of the service.
        max_photos: kept at once.

    Attributes:
        looker: that looks at photographs.
    """

    def __init__(self, runner: Runner, fields: FieldCatalogue, data_dir: Path, max_photos: int) -> None:
        super().__init__(data_dir / "photos", max_photos)
        self._runner, self._fields = runner, fields
        self.looker = PhotoLooker()

    def stop(self) -> None:
        """End the process that looks at photos, if there is one. Calling it again does nothing."""
        self.looker.stop()

    # Photographs

    def receive(self, data: bytes, name: str, focal_px: float | None = None, board: str = "") -> TablePhoto:
        """Keep a photograph.

        Args:
            data: a picture in any usual format.
            name: for people.
            focal_px: focal length in pixels of the photo; None where nobody knows.
            board: that may be in view, as `board_of` reads it.

        Raises:
            PhotoRefused: if it cannot be used.
            InvalidInput: if the focal length or the board makes no sense.
            ProcessUnavailable: if what decodes it died.
            TooManyPhotos: if there are too many.
            StorageFull, CannotStore: if nothing more may be written, or the disk is full.
        """
        read = self._look(data, focal_px, None, board)
        self._runner.storage.check_room()
        facts = uuid.uuid4().hex[:12], name, now_utc(), read.width, read.height, read.sent_width
        photo = TablePhoto(*facts, np.array(read.K), read.source, read.T_world_camera, read.notes, board=board)
        self.keep(photo, data, read.jpeg, read.straight)
        self._runner.hub.publish(PhotosChanged())
        return photo

    def set_camera(
        self, photo: str, focal_px: float | None, camera: KnownCamera | None = None, board: str | None = None
    ) -> TablePhoto:
        """Look at a photograph with another focal length, in pixels of the photo as it was sent, or calibrated camera.

        Args:
            photo: identifier.
            focal_px: focal length; None for what board or file give.
            camera: that took it; the focal length does not count then.
            board: that may be in view, as `board_of` reads it; None keeps the present one.

        Raises:
            UnknownName: if there is none.
            InvalidInput: if focal length or board make no sense, or the camera took photographs of another shape.
        """
        board = self.get(photo).board if board is None else board
        read = self._look(self.read(self.sent(photo), photo), focal_px, camera, board)
        facts = {"board": board, "K": np.array(read.K), "source": read.source, "T_world_camera": read.T_world_camera}
        files = {PICTURE: read.jpeg, STRAIGHT: read.straight}
        return self._outdated(photo, lambda latest: replace(latest, **facts, notes=read.notes), files)

    def remove(self, name: str) -> None:
        """Delete a photograph, damaged or not; tables and goals that were made of it stay.

        Raises:
            UnknownName: if there is none.
            CannotStore: if that is not allowed.
        """
        with contextlib.suppress(CorruptFile):  # then nobody knows which search it began
            self._end_search(self.get(name))
        super().remove(name)
        self._runner.storage.outdate()
        self._runner.hub.publish(PhotosChanged())

    # What is marked

    def mark(self, photo: str, name: str, mark: Mark) -> TablePhoto:
        """Point at an object; its mask is found.

        Raises:
            UnknownName: if there is no such photo, or no field of the object.
            InvalidInput: if the mark makes no sense, nothing is found, or too many objects are marked.
        """
        before = self.get(photo)
        check_known("object with a field", [name], self._fields.names())
        if len({name, *(entry.name for entry in before.objects)}) > MAX_OBJECTS:
            raise InvalidInput("number of objects in the photo", len(before.objects) + 1, f"at most {MAX_OBJECTS}")
        others = tuple(point for each in before.objects if each.name != name for point in each.mark.on)
        asked = replace(mark, off=(*mark.off, *others))  # what is another object is not this one
        found = self.looker.ask(FindMask(self.read(self.picture(photo), photo), asked))
        assert isinstance(found, MaskFound)
        entry = MarkedObject(name, mark, found.outline, doubt=found.doubt)
        return self._outdated(photo, lambda latest: latest.with_object(entry), {mask_file(name): found.png})

    def unmark(self, photo: str, name: str) -> TablePhoto:
        """Forget what was marked of an object.

        Raises:
            UnknownName: if there is no such photo, or the object was not marked.
        """

        def without(latest: TablePhoto) -> TablePhoto:
            latest.marked(name)
            return replace(latest, objects=tuple(entry for entry in latest.objects if entry.name != name))

        return self._outdated(photo, without)

    # What is found

    def find(self, photo: str, together: Sequence[str] = (), seed: int = 0) -> TablePhoto:
        """Queue the job that finds the marked objects.

        Args:
            photo: identifier.
            together: further photographs of the same table.
            seed: of the searches.

        Raises:
            UnknownName: if there is no such photo.
            NothingMarked: if no object is marked.
            MissingFields: if an object can no longer be recognised.
            InvalidInput: if one of several shows neither the board nor an object that another shows.
            QueueFull, StorageFull: if too many jobs wait, or nothing more may be written.
        """
        check_seed(seed)
        photos = [self.get(each) for each in dict.fromkeys((photo, *together))]
        first = photos[0]
        if not first.objects:
            raise NothingMarked
        marked = [{entry.name for entry in each.objects} for each in photos]
        check_shared(marked, [each.T_world_camera is not None for each in photos])
        names = tuple(dict.fromkeys(entry.name for each in photos for entry in each.objects))
        self._fields.require(names, "ours")
        self._end_search(first)
        params = PhotoParams(
            photo=first.id, title=first.name, names=names, seed=seed, notes=first.notes,
            board=first.board, photos=tuple(map(_order, photos)),
        )  # fmt: skip
        with self._runner.jobs.new_inputs() as folder:
            fill_inputs(folder, self._inputs(photos))
            job = self._runner.submit_with_inputs(KIND, params, folder)
        # What was marked meanwhile is not what is looked for.
        return self.change(photo, lambda latest: replace(latest, job=job.id) if _is_same(latest, first) else latest)

    def choose(self, photo: str, name: str, choice: int) -> TablePhoto:
        """Take one of the poses that were found of an object; that settles what is doubtful about it.

        Raises:
            UnknownName: if there is no such photo or object.
            NotFoundYet: if nothing has been found yet.
            InvalidInput: if there are fewer poses.
        """
        before = self.get(photo)
        before.marked(name)
        found = {entry.name: entry for entry in self.found(before).objects}
        count = len(found[name].poses())
        if not 0 <= choice < count:
            raise InvalidInput("number of the pose", choice, f"0 to {count - 1}")
        return self.change(photo, lambda latest: latest.with_object(replace(latest.marked(name), choice=choice)))

    def doubts(self, photo: TablePhoto, found: FoundScene) -> tuple[str, ...]:
        """Why objects should not be trusted, without those of which a person has chosen a pose."""
        settled = {entry.name for entry in photo.objects if entry.choice is not None}
        return tuple(each.doubt for each in found.objects if each.doubt and each.name not in settled)

    def job(self, photo: TablePhoto) -> Job | None:
        """The estimate of what is marked now; None if there is none."""
        try:
            return None if photo.job is None else self._runner.jobs.get(photo.job, KIND)
        except UnknownName:  # it was deleted
            return None

    def found(self, photo: TablePhoto) -> FoundScene:
        """What was found.

        Raises:
            NotFoundYet: if nothing has been found yet.
            CorruptFile: if the file is damaged.
        """
        job = self.job(photo)
        if job is None or job.state != "done":
            raise NotFoundYet
        return read_json(
            self._runner.jobs.folder(job.id) / FOUND, lambda data: decode(FoundScene, data, "found objects")
        )

    # Inside

    def change(self, photo: str, changed: Callable[[TablePhoto], TablePhoto], files: Files | None = None) -> TablePhoto:
        """Keep other facts and files of a photograph, made of the latest ones, and publish that.

        Raises:
            UnknownName: if there is none, or as `changed`.
            CannotStore: if the disk is full.
        """
        after = super().change(photo, changed, files or {})
        self._runner.hub.publish(PhotosChanged())
        return after

    def _outdated(
        self, photo: str, changed: Callable[[TablePhoto], TablePhoto], files: Files | None = None
    ) -> TablePhoto:
        """Keep a photograph of which something else is to be found now; a search for what was before ends."""
        self._end_search(self.get(photo))

        def then(latest: TablePhoto) -> TablePhoto:
            after = changed(latest)
            return replace(after, objects=tuple(replace(each, choice=None) for each in after.objects), job=None)

        return self.change(photo, then, files)

    def _end_search(self, photo: TablePhoto) -> None:
        job = self.job(photo)
        if job is not None and not job.is_finished:
            with contextlib.suppress(OsfError):  # it has just ended by itself
                self._runner.jobs.cancel(job.id)

    def read(self, path: Path, photo: str) -> bytes:
        """A file of a photograph, which may just have been deleted.

        Raises:
            UnknownName: if so.
        """
        try:
            return path.read_bytes()
        except FileNotFoundError:
            raise NotThere("photo") from None

    def _inputs(self, photos: Sequence[TablePhoto]) -> dict[str, Path]:
        """What the job gets of photographs, by the names that it knows."""
        files: dict[str, Path] = {}
        for number, photo in enumerate(photos):
            masks = {entry.name: self.mask(photo.id, entry.name) for entry in photo.objects}
            straight = self.straight(photo.id)
            files |= inputs_of(number, straight if straight.is_file() else self.sent(photo.id), masks)
        return files

    def _look(self, data: bytes, focal_px: float | None, camera: KnownCamera | None, board: str) -> PhotoRead:
        read = self.looker.ask(ReadPhoto(data, focal_px, camera, board_of(board)))
        assert isinstance(read, PhotoRead)
        return read


def _is_same(one: TablePhoto, other: TablePhoto) -> bool:
    """Whether the same is marked, in pictures of the same camera."""
    now, before = ([(each.name, each.mark) for each in photo.objects] for photo in (one, other))
    return now == before and np.array_equal(one.K, other.K)


def _order(photo: TablePhoto) -> PhotoInput:
    T = None if photo.T_world_camera is None else photo.T_world_camera.matrix().tolist()
    names, focal_known = [entry.name for entry in photo.objects], photo.source != "assumed"
    boxes = {entry.name: list(entry.mark.box) for entry in photo.objects if not entry.mark.strokes}
    return PhotoInput(K=photo.K.tolist(), T_world_camera=T, names=names, focal_known=focal_known, boxes=boxes)


# What becomes of a photographed table: a table of the simulation, or a goal of one; and how it looks when drawn


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
        photos: know what was found.
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
        scene = self._runner.scenes.create(poses=tuple(layout.poses.items()), light=layout.light, is_measured=True)
        place = layout.T_table_photo
        self._photos.change(photo, lambda latest: replace(latest, scene=scene.id, T_table_photo=place))
        rests = {name: scene.initial.pose(name) for name in layout.poses}
        return TableMade(scene, _moved(layout.poses, rests))

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
        camera = record.as_found(found).camera(layout.T_table_camera, GOAL_SIDE)
        png = self._reduced(record, camera)
        table = home or self._elsewhere(layout)
        try:
            made = self._runner.scenes.compose(ComposeGoal(table.id, tuple(layout.poses.items()), is_measured=True))
            goal = self._goals.keep_photographed(record.name, table.id, camera, made.poses, png)
        except OsfError:
            if home is None:
                self._runner.delete_scene(table.id)
            raise
        if home is None:
            self._runner.scenes.activate(table.id)
        return GoalMade(table, _moved(layout.poses, dict(made.poses)), goal)

    def drawing(self, photo: str) -> bytes:
        """PNG of how the found scene looks from the photograph's camera, with its shadows.

        Raises:
            UnknownName: if there is no such photo.
            NotFoundYet, NoPhotographedTable: if it is not known how the objects lie.
            ProcessUnavailable: if what renders died.
        """
        record = self._photos.get(photo)
        found = self._photos.found(record)
        layout = layout_of(found, _choices(record))
        state = SceneState(tuple(layout.poses), Pose.stacked(layout.poses.values()), layout.light, None)
        camera = record.as_found(found).camera(layout.T_table_camera, _DRAWN_SIDE)
        masks = tuple(self._photos.read(self._photos.mask(photo, entry.name), photo) for entry in record.objects)
        picture = self._photos.read(self._photos.picture(photo), photo)
        return self._link.call(DrawPhoto(uuid.uuid4().hex, state, camera, picture, masks))

    def _layout(self, record: TablePhoto, scene: str | None = None, *, despite_doubts: bool) -> TableLayout:
        found = self._photos.found(record)
        if not despite_doubts and (doubts := self._photos.doubts(record, found)):
            raise PhotoDoubtful(doubts)
        T_table_board: Pose | None = None  # on the table, if that was made of a photograph of the same board
        if found.table == "board" and scene is not None:
            with_board = (each for each in (record, *self._photos.all()) if each.T_world_camera is not None)
            T_table_board = next((each.T_table_photo for each in with_board if each.scene == scene), None)
        return layout_of(found, _choices(record), T_table_board)

    def _home(self, scene: str | None, names: set[str]) -> SceneRecord | None:
        """The table that was asked for, else the current one if it holds the objects; None if there is none."""
        if scene is not None:
            return self._runner.scenes.get(scene)
        current = None if self._runner.scenes.current is None else self._runner.scenes.get(self._runner.scenes.current)
        return current if current is not None and set(current.state.names) == names else None

    def _elsewhere(self, layout: TableLayout) -> SceneRecord:
        """A new table, not shown yet, whose objects lie on the same sides as in the photo, but in other places."""
        poses = tuple(layout.poses.items())
        draft = self._runner.scenes.create(poses=poses, light=layout.light, is_measured=True, is_shown=False)
        try:
            start = self._shifted(draft)
        finally:
            self._runner.delete_scene(draft.id)
        return self._runner.scenes.create(poses=start, light=layout.light, seed=draft.seed, is_shown=False)

    def _shifted(self, draft: SceneRecord) -> Poses:
        """A random layout: all objects shifted, or as many as there is room for."""
        with contextlib.suppress(NoRoom):
            count = len(draft.state.names)
            return self._runner.scenes.compose(ComposeGoal(draft.id, seed=draft.seed, moved=count)).poses
        return self._runner.scenes.compose(ComposeGoal(draft.id, seed=draft.seed)).poses

    def _reduced(self, record: TablePhoto, camera: Camera) -> bytes:
        """PNG of a photograph, as large as a camera's images."""
        jpeg = self._photos.read(self._photos.picture(record.id), record.id)
        pixels = cv2.imdecode(np.frombuffer(jpeg, np.uint8), cv2.IMREAD_COLOR)
        assert pixels is not None, "it was encoded here"
        size = camera.width, camera.height
        return encode_png(cv2.resize(pixels, size, interpolation=cv2.INTER_AREA)[..., ::-1])


def _choices(record: TablePhoto) -> dict[str, int]:
    return {entry.name: entry.choice or 0 for entry in record.objects}


def _moved(asked: Mapping[str, Pose], rests: Mapping[str, Pose]) -> tuple[str, ...]:
    """A sentence for each object that did not stay where it was found."""
    notes = []
    for name, pose in asked.items():
        there = rests[name]
        shift = float(np.linalg.norm((there.position - pose.position)[:2]))
        if shift > _STAYED_M:
            notes.append(f"{name} did not stay where the photo shows it: it moved by {100 * shift:.0f} cm.")
        elif (turn := float(rotation_angle(there.quaternion, pose.quaternion))) > _STAYED_RAD:
            turned = f"it turned by {np.rad2deg(turn):.0f} degrees"
            notes.append(f"{name} did not stay as the photo shows it: {turned} when it was let go.")
    return tuple(notes)


# Photographs of the board, from which a camera is calibrated; only where its corners are is kept, and in memory


_MOST_KEPT = 300  # of all visitors; the oldest are forgotten


class BoardPhotos:
    """Where the board is in photographs. Methods block; any thread may call.

    Args:
        ask: lets the process that looks at photographs carry out an order.
    """

    def __init__(self, ask: Callable[[PhotoOrder], PhotoAnswer]) -> None:
        self._ask = ask
        self._lock = threading.Lock()
        self._sightings: dict[str, Sighting] = {}

    def add(self, data: bytes, name: str, board: Board) -> tuple[str, Sighting]:
        """Look for a board in a photograph; an identifier, and where it is.

        Raises:
            PhotoRefused: if it cannot be used, or shows no board.
            ProcessUnavailable: if what decodes it died.
        """
        sighting = self._ask(SightBoard(data, name, board))
        assert isinstance(sighting, Sighting)
        identifier = uuid.uuid4().hex[:12]
        with self._lock:
            self._sightings[identifier] = sighting
            while len(self._sightings) > _MOST_KEPT:
                del self._sightings[next(iter(self._sightings))]
        return identifier, sighting

    def assess(self, views: Sequence[str], table: str | None, T_world_board: Pose) -> Calibration:
        """What photographs show of the camera so far; arguments as of the core's `assess`, photographs by identifier.

        Raises:
            UnknownName: if there is no such photograph.
            PhotoRefused: naming one that contradicts the others.
            InvalidInput: if all contradict each other.
            ProcessUnavailable: if what calibrates died.
        """
        seen = tuple(map(self._sighting, views))
        on_table = None if table is None else self._sighting(table)
        found = self._ask(AssessCamera(seen, on_table, T_world_board))
        assert isinstance(found, Calibration)
        return found

    def _sighting(self, identifier: str) -> Sighting:
        with self._lock:
            if identifier not in self._sightings:
                raise NotThere("photo of the board")
            return self._sightings[identifier]


# The service's end of the process that looks at photographs


_PATIENCE_S = 30.0  # sound photos take three, and a busy machine some to start the process


class PhotoLooker:
    """Lets orders be carried out one at a time; the process starts with the first one, and again if it dies."""

    def __init__(self) -> None:
        self._process = ProcessClient(photo_main, (), "reader of photos", answer_s=_PATIENCE_S)
        self._one_at_a_time = threading.Lock()  # so that none waits for another's time

    def ask(self, order: PhotoOrder) -> PhotoAnswer:
        """Let an order be carried out. Blocks; any thread may call.

        Raises:
            PhotoRefused: if the photo cannot be used, or takes too long.
            InvalidInput: if the order makes no sense.
            ProcessUnavailable: if the process died.
        """
        try:
            with self._one_at_a_time:
                return self._process.call(order)
        except ProcessHangs:
            late = f"The photo could not be looked at within {_PATIENCE_S:g} s; save it anew as a plain JPEG."
            raise PhotoRefused(late) from None

    def stop(self) -> None:
        """End the process, if there is one. Calling it again does nothing."""
        self._process.stop()
