"""Goal images: keeping and composing them, and checking what a photo shows."""

from __future__ import annotations

import io
import threading
import uuid
from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Literal

import numpy as np
from jaxtyping import UInt8
from PIL import Image

from osfcore.errors import InvalidInput, OsfError, OverlappingObjects, UnknownName, check_known
from osfcore.estimation.goal_view import is_goal_view
from osfcore.estimation.steps import ContentCheck, Verdict
from osfcore.geometry.cameras import Camera, goal_camera
from osfcore.geometry.light import Light
from osfcore.io.files import reading_png

from ..processes.client import ProcessClient, ProcessUnavailable
from ..processes.messages.neural_messages import CheckPhoto
from ..processes.messages.scene_messages import ComposeGoal, SceneRecord
from ..storage.database import now_utc
from ..storage.photos import Photo, PhotoCrop, PhotoReader, central_crop, check_crop, cut_out
from ..storage.records import GoalRecord, GoalStore, PhotoRecord, Poses, Source
from .fields import FieldCatalogue, MissingFields
from .runner import Runner
from .scenes import Scenes, scene_or_current

# Goals: photos of how the table should look, uploaded, composed by hand, or drawn at random


GOAL_SIDE = 256  # of images that are made here [px]


class NoDraft(OsfError):
    """Nothing is being composed."""

    def __init__(self) -> None:
        super().__init__("No goal is being composed; begin one first.")


class NoTable(OsfError):
    """There is no scene from which a goal could be made."""

    def __init__(self) -> None:
        super().__init__("There is no scene to make a goal of; make one first.")


class NoPhoto(OsfError):
    """A goal of which nothing can be cut out."""

    def __init__(self, name: str) -> None:
        super().__init__(f"{name} was not cut out of a photo, so there is nothing to crop; upload the photo again.")


class DraftUnsound(OsfError):
    """A draft that cannot be a goal yet."""


@dataclass(frozen=True, eq=False, slots=True)
class Draft:
    """A goal that is being composed, the same for all visitors.

    Attributes:
        scene: whose objects are laid out.
        poses: where they shall be.
        problem: why they cannot be there; empty if they can.
        revision: grows with every change.
    """

    scene: str
    poses: Poses
    problem: str = ""
    revision: int = 0


@dataclass(frozen=True, eq=False, slots=True)
class DraftChanged:
    """A goal is being composed like this now; None if none is."""

    draft: Draft | None


@dataclass(frozen=True, slots=True)
class GoalsChanged:
    """The list of goals is another one now."""


class Goals(GoalStore):
    """The goals of one service. Methods that change something block; any thread may call.

    Args:
        runner: holds the scenes, and publishes what has changed.
        data_dir: of the service.
        max_goals: kept at once.
        photos: decodes what is uploaded.
    """

    def __init__(self, runner: Runner, data_dir: Path, max_goals: int, photos: PhotoReader) -> None:
        super().__init__(data_dir / "goals", max_goals)
        self._runner, self._photos = runner, photos
        self._drafting = threading.RLock()
        self._draft: Draft | None = None
        self._draft_png = b""

    # Goals that are kept

    def remove(self, name: str) -> None:
        """Delete a goal, damaged or not.

        Raises:
            UnknownName: if there is none.
            CannotStore: if that is not allowed.
        """
        super().remove(name)
        self._runner.storage.outdate()
        self._runner.hub.publish(GoalsChanged())

    def receive(self, data: bytes, name: str, camera: Camera | None = None) -> GoalRecord:
        """Keep a photo; its middle, in the proportions of its camera, becomes the goal image.

        Args:
            data: a picture in any usual format.
            name: for people.
            camera: that took it; None for the scenes' goal camera.

        Raises:
            PhotoRefused: if it cannot be used.
            ProcessUnavailable: if what decodes it died.
            TooManyGoals: if there are too many.
            StorageFull, CannotStore: if nothing more may be written, or the disk is full.
        """
        return self.receive_read(self.read(data), name, camera)

    def read(self, data: bytes) -> Photo:
        """A picture in any usual format, decoded.

        Raises:
            PhotoRefused: if it cannot be used.
            ProcessUnavailable: if what decodes it died.
        """
        return self._photos.read(data)

    def receive_read(self, photo: Photo, name: str, camera: Camera | None = None) -> GoalRecord:
        """Keep a photo that has been decoded, as `receive` does."""
        camera = camera or goal_camera()
        crop = central_crop(photo.width, photo.height, camera)
        pixels = cut_out(photo, crop, camera)
        seen_by = camera.resized(pixels.shape[1], pixels.shape[0])
        whole = PhotoRecord(photo.width, photo.height, crop), _encoded(photo.pixels, "JPEG", quality=95)
        return self._keep_new("upload", name, None, seen_by, None, _encoded(pixels, "PNG"), photo=whole)

    def crop(self, goal: str, crop: PhotoCrop) -> GoalRecord:
        """Cut another part out of the photo of a goal.

        Raises:
            UnknownName: if there is no such goal.
            NoPhoto: if it was not cut out of a photo.
            InvalidInput: if the part is too small, or beside the photo.
            CorruptFile: if the photo is damaged.
            CannotStore: if the disk is full.
        """
        record = self.get(goal)
        if record.photo is None:
            raise NoPhoto(record.name)
        size = record.photo.width, record.photo.height
        check_crop(crop, *size, record.camera)
        path = self.photo(goal)
        with reading_png(path, "it is damaged; upload the photo again"), Image.open(path) as image:
            pixels = cut_out(Photo(np.asarray(image.convert("RGB")), *size), crop, record.camera)
        camera = record.camera.resized(pixels.shape[1], pixels.shape[0])
        record = replace(record, camera=camera, photo=PhotoRecord(*size, crop))
        self.replace(record, _encoded(pixels, "PNG"))
        self._runner.hub.publish(GoalsChanged())
        return record

    def compose(
        self, scene: str | None, poses: Poses, name: str, light: Light | None = None, example: str | None = None
    ) -> GoalRecord:
        """Keep a goal in which objects of a scene lie elsewhere.

        Args:
            scene: None for the current one.
            poses: of the objects that lie elsewhere; they come to rest as if let go.
            name: for people.
            light: in which it is seen; None for the scene's.
            example: whose goal it is; None if it is anybody's own.

        Raises:
            NoTable, UnknownName: if there is no such scene or object.
            SceneHeld: if a job uses the scene.
            OsfError: if objects would overlap or lie beside the table; or as `receive`.
        """
        command = ComposeGoal(self._scene(scene), poses, light=light, size=GOAL_SIDE)
        return self._made("composed", command, name, example)

    def draw(
        self, scene: str | None, seed: int, moved: int | None, name: str, light: Light | None = None
    ) -> GoalRecord:
        """Keep a goal in which some objects of a scene lie elsewhere at random.

        Args:
            scene: None for the current one.
            seed: of the layout.
            moved: how many objects lie elsewhere; None to draw the number too.
            name: for people.
            light: in which it is seen; None for the scene's.

        Raises:
            NoTable, UnknownName: if there is no such scene.
            SceneHeld: if a job uses the scene.
            OsfError: if there is no room, or as `receive`.
        """
        command = ComposeGoal(self._scene(scene), seed=seed, moved=moved, light=light, size=GOAL_SIDE)
        return self._made("drawn", command, name)

    def keep_photographed(self, name: str, scene: str, camera: Camera, poses: Poses, png: bytes) -> GoalRecord:
        """Keep a layout that was found in a photograph, with that as its image; raises as `receive`."""
        return self._keep_new("photo", name, scene, camera, poses, png)

    def _made(self, source: Source, command: ComposeGoal, name: str, example: str | None = None) -> GoalRecord:
        made = self._runner.scenes.compose(command)
        return self._keep_new(source, name, command.id, goal_camera(GOAL_SIDE), made.poses, made.png, example)

    def _keep_new(
        self,
        source: Source,
        name: str,
        scene: str | None,
        camera: Camera,
        poses: Poses | None,
        png: bytes,
        example: str | None = None,
        photo: tuple[PhotoRecord, bytes] | None = None,
    ) -> GoalRecord:
        self._runner.storage.check_room()
        facts, jpeg = (None, None) if photo is None else photo
        record = GoalRecord(uuid.uuid4().hex[:12], name, now_utc(), source, scene, camera, poses, example, facts)
        self.keep(record, png, jpeg)
        self._runner.hub.publish(GoalsChanged())
        return record

    def _scene(self, scene: str | None) -> str:
        return scene_or_current(self._runner.scenes, scene, NoTable).id

    # The one that is being composed

    @property
    def draft(self) -> Draft | None:
        """What is being composed now."""
        return self._draft

    def begin_draft(self, scene: str | None = None) -> Draft:
        """Begin with where the objects of a scene, by default the current one, are now.

        Raises:
            NoTable, UnknownName: if there is no such scene.
            SceneHeld: if a job uses the scene.
        """
        with self._drafting:
            scene = self._scene(scene)
            made = self._runner.scenes.compose(ComposeGoal(scene, size=GOAL_SIDE))
            return self._set_draft(scene, made.poses, png=made.png)

    def move_draft(self, poses: Poses) -> Draft:
        """Put objects of the draft elsewhere; where they cannot be, the draft says so.

        Raises:
            NoDraft: if there is none.
            UnknownName: if an object is not in it.
            OsfError: if the scene has gone, is used by a job, or the simulation is not there now.
        """
        with self._drafting:
            draft = self._require_draft()
            before, moved = dict(draft.poses), dict(poses)
            check_known("object of the draft", moved, before)
            laid = tuple((before | moved).items())
            try:
                made = self._runner.scenes.compose(ComposeGoal(draft.scene, laid, size=GOAL_SIDE))
            except (OverlappingObjects, InvalidInput) as error:  # what a hand can do wrong while it composes
                return self._set_draft(draft.scene, laid, problem=str(error))
            return self._set_draft(draft.scene, made.poses, png=made.png)

    def draft_image(self) -> bytes:
        """PNG of what the goal camera would see; while there is a problem, the last one without.

        Raises:
            NoDraft: if there is none.
        """
        self._require_draft()
        return self._draft_png

    def keep_draft(self, name: str) -> GoalRecord:
        """Keep the draft as a goal, and end it.

        Raises:
            NoDraft: if there is none.
            DraftUnsound: if objects cannot be where they are in it.
            TooManyGoals, CannotStore: as `receive`.
        """
        with self._drafting:
            draft = self._require_draft()
            if draft.problem:
                raise DraftUnsound(f"This cannot be a goal yet. {draft.problem}")
            camera = goal_camera(GOAL_SIDE)
            record = self._keep_new("composed", name, draft.scene, camera, draft.poses, self._draft_png)
            self.drop_draft()
            return record

    def drop_draft(self) -> None:
        """End composing; does nothing if nothing is being composed."""
        with self._drafting:
            if self._draft is not None:
                self._draft = None
                self._runner.hub.publish(DraftChanged(None))

    def _set_draft(self, scene: str, poses: Poses, *, problem: str = "", png: bytes | None = None) -> Draft:
        revision = 1 if self._draft is None else self._draft.revision + 1
        self._draft = Draft(scene, poses, problem, revision)
        if png is not None:
            self._draft_png = png
        self._runner.hub.publish(DraftChanged(self._draft))
        return self._draft

    def _require_draft(self) -> Draft:
        if self._draft is None:
            raise NoDraft
        return self._draft


def _encoded(pixels: UInt8[np.ndarray, "h w 3"], kind: str, **options: int) -> bytes:
    data = io.BytesIO()
    Image.fromarray(pixels).save(data, kind, **options)
    return data.getvalue()


# Whether a goal can be one for a table, answered within seconds and before anything starts, in words for people


GoalVerdict = Verdict | Literal["other table"]
_MOST_REMEMBERED = 200
_TEXTS: dict[Verdict, str] = {
    "shown": "",
    "doubtful": "It is not certain that this photo shows {objects}.",
    "bare": "Nothing can be seen on the table in this photo; choose one that shows {objects}.",
    "elsewhere": "This photo does not show the table as the goal camera sees it; mark the objects in it, or crop it.",
    "others": "This photo does not seem to show {objects}; choose another one, or a table with what it shows.",
}


@dataclass(frozen=True, slots=True)
class GoalCheck:
    """What a goal shows, compared with a table.

    Attributes:
        verdict: as `ContentCheck`; or "other table" if it is known to hold other objects.
        text: what is wrong, and what to do; empty if nothing is.
        scene: the table for which it was made, if it is another one and still there.
    """

    verdict: GoalVerdict
    text: str = ""
    scene: str | None = None

    @property
    def is_refused(self) -> bool:
        """Whether an episode with this goal makes no sense."""
        return self.verdict not in ("shown", "doubtful")


class GoalRefused(OsfError):
    """A goal that cannot be reached with the objects of the table."""


class GoalChecks:
    """Checks goals, and remembers what it has found. Methods block; any thread may call.

    Args:
        scenes: of the service.
        fields: what can be recognised.
        goals: goal images.
        link: to the process that looks at photos.
        labels: names of objects for people.
    """

    def __init__(
        self,
        scenes: Scenes,
        fields: FieldCatalogue,
        goals: Goals,
        link: ProcessClient,
        labels: Callable[[], Mapping[str, str]],
    ) -> None:
        self._scenes, self._fields, self._goals, self._link, self._labels = scenes, fields, goals, link, labels
        self._found: dict[object, ContentCheck] = {}
        self._one_at_a_time = threading.Lock()  # a second page that asks the same waits for the first one's answer

    def check(self, goal: str, scene: str | None = None) -> GoalCheck:
        """Compare a goal with a table, the current one if none is named.

        Raises:
            NoTable, UnknownName: if there is no such table or goal.
            MissingFields: if an object of the table cannot be recognised.
            ProcessUnavailable: if what looks at photos has died.
        """
        record = self._goals.get(goal)
        table = scene_or_current(self._scenes, scene, NoTable)
        if record.poses is not None:
            return self._made_here(record, table)
        if missing := sorted(set(table.state.names) - set(self._fields.names())):
            raise MissingFields(missing)
        verdict = self._content(record, table).verdict
        return GoalCheck(verdict, _TEXTS[verdict].format(objects=self._listed(table.state.names)))

    def is_goal_view(self, photo: Photo) -> bool:
        """Whether the middle of a picture shows the table as the goal camera sees it, from whatever it holds."""
        camera = goal_camera()
        pixels = cut_out(photo, central_crop(photo.width, photo.height, camera), camera)
        return is_goal_view(self._fields.load_table(), pixels / np.float32(255), camera)

    def require(self, goal: str, scene: str) -> None:
        """Refuse a goal that makes no sense for a table.

        Raises:
            GoalRefused: if so; otherwise as `check`.
        """
        try:
            check = self.check(goal, scene)
        except ProcessUnavailable:  # the episode looks at the photo itself, and refuses what it does not explain
            return
        if check.is_refused:
            raise GoalRefused(check.text)

    def _made_here(self, goal: GoalRecord, table: SceneRecord) -> GoalCheck:
        """A goal of which it is known what it holds."""
        names = tuple(name for name, _ in goal.poses or ())
        if set(names) == set(table.state.names):
            return GoalCheck("shown")
        text = f"This goal was made for another table, with {self._listed(names)}."
        try:
            home = None if goal.scene is None else self._scenes.get(goal.scene).id
        except UnknownName:
            home = None
        return GoalCheck("other table", text, home)

    def _content(self, goal: GoalRecord, table: SceneRecord) -> ContentCheck:
        with self._one_at_a_time:
            stamps = tuple(self._fields.stamp(name) for name in table.state.names)
            key = (goal.id, goal.photo, table.state.names, stamps)
            if key not in self._found:
                photo = self._goals.image(goal.id).read_bytes()
                answer = self._link.call(CheckPhoto(uuid.uuid4().hex, table.state, goal.camera, photo))
                assert isinstance(answer, ContentCheck)
                self._found[key] = answer
                while len(self._found) > _MOST_REMEMBERED:
                    self._found.pop(next(iter(self._found)))
            return self._found[key]

    def _listed(self, names: tuple[str, ...]) -> str:
        labels = self._labels()
        *others, last = [f"the {labels[name].lower()}" if name in labels else name for name in names]
        return f"{', '.join(others)} and {last}" if others else last
