"""Scenes: kept in the store, simulated in a process of their own, changed by one caller at a time."""

from __future__ import annotations

import asyncio
import secrets
import threading
import uuid
from collections import OrderedDict
from collections.abc import Awaitable, Callable, Iterable
from dataclasses import replace
from typing import Any

from osfcore.errors import InvalidInput, NotThere, OsfError, check_unique
from osfcore.geometry.cameras import DEFAULT_IMAGE_SIDE, image_side
from osfcore.geometry.light import Light
from osfcore.geometry.poses import Pose, unit_quaternion
from osfcore.geometry.states import MAX_OBJECTS
from osfcore.geometry.workspace import check_action
from osfcore.objects.asset_library import AssetLibrary
from osfcore.world.simulators import Simulator

from ..jobs.params import MAX_SEED
from ..processes.client import ProcessClient, Status
from ..processes.messages.scene_messages import (
    Act,
    AdoptScene,
    Command,
    ComposedGoal,
    ComposeGoal,
    CreateScene,
    Disturb,
    DropScene,
    EditScene,
    FramesTaken,
    JobCommand,
    ObservedScene,
    ObserveScene,
    ResetScene,
    SceneChanged,
    SceneRecord,
    ShowScene,
    TakeImage,
    TakeMask,
    UndoDisturbances,
    WatchFrames,
)
from ..processes.sim_process import simulation_main
from ..storage.database import CannotStore, Store, now_utc
from ..storage.records import Poses
from .event_hub import CurrentScene, Hub, Notice
from .service_settings import Settings

DEMO_OBJECTS = 3
_LOST = "The simulation stopped unexpectedly and is being restarted."


class SceneHeld(OsfError):
    """A job drives the scene, so hands have to stay off."""

    def __init__(self, by: str) -> None:
        super().__init__(f"The {by} that runs is using this table; pause or cancel it first.")


class TooManyScenes(OsfError):
    """No more scenes are kept."""

    def __init__(self, limit: int) -> None:
        super().__init__(f"There are {limit} tables already, which is the most; delete one in Lab, Scenes, first.")


class Scenes:
    """The scenes of one data directory. Changing one waits for the simulation; any thread may call.

    Args:
        settings: of the service.
        store: keeps them.
        library: meshes of the objects.
        hub: called with every change.
        holder: returns what drives a scene, in words, if a job does: then only that job may change it.
    """

    def __init__(
        self,
        settings: Settings,
        store: Store,
        library: AssetLibrary,
        hub: Hub,
        holder: Callable[[str], str | None] = lambda _: None,
    ) -> None:
        self._settings, self._store, self._library, self._hub, self._holder = settings, store, library, hub, holder
        self._simulation = ProcessClient(
            simulation_main,
            (library.root, settings.max_live_worlds, settings.simulator),
            "simulation",
            answer_s=settings.stage_timeout_s,
            keeps_running=True,
            greeting=self._greeting,
            on_event=self._on_simulation_event,
            on_lost=lambda: hub.publish(Notice("error", _LOST)),
        )
        self._lock = threading.RLock()
        self._records: dict[str, SceneRecord] = {}
        self._current: str | None = None
        self._watchers = self._scenes_in_the_making = 0
        self._images = SceneImages(
            settings.image_cache_bytes, lambda scene: self.get(scene).revision, self._simulation.call_async
        )

    def start(self) -> None:
        """Take over the scenes that the store holds, and start the simulation."""
        records, current = self._store.scenes()
        self._records = {record.id: record for record in records}
        self._current = current or next(reversed(self._records), None)
        self._simulation.start()

    def stop(self) -> None:
        """End the simulation. Calling it again does nothing."""
        self._simulation.stop()

    # Reading

    @property
    def status(self) -> Status:
        """Whether scenes can be worked with."""
        return self._simulation.status

    @property
    def simulator(self) -> Simulator:
        """What moves the objects."""
        return self._settings.simulator

    def all(self) -> tuple[SceneRecord, ...]:
        """All scenes, oldest first."""
        return tuple(self._records.values())  # without the lock: whoever writes to the disk holds it

    @property
    def current(self) -> str | None:
        """The scene that is shown."""
        return self._current

    def get(self, scene: str) -> SceneRecord:
        """Return one scene.

        Raises:
            UnknownName: if there is none.
        """
        record = self._records.get(scene)
        if record is None:
            raise NotThere("scene")
        return record

    # Changing

    def create(
        self,
        names: tuple[str, ...] | None = None,
        count: int = DEMO_OBJECTS,
        seed: int | None = None,
        light: Light | None = None,
        poses: Poses | None = None,
        image_size: int = DEFAULT_IMAGE_SIDE,
        *,
        is_measured: bool = False,
        is_shown: bool = True,
    ) -> SceneRecord:
        """Make a scene; raises TooManyScenes, or an OsfError if it cannot be made: then nothing changes.

        Args:
            names: its objects; None for those of the poses, or `count` random ones.
            count: see there.
            seed: decides whatever is left open; None for a random one.
            light: None for a random one.
            poses: T_world_object [m] by name; None for random ones at rest.
            image_size: side of its camera images [px].
            is_measured: the poses may err: what penetrates is moved apart, and all comes to rest.
            is_shown: at once, in viewer and pages.
        """
        image_side(image_size)
        names = self._checked_names(names, poses)
        stacked = None if poses is None else _stacked(poses)
        with self._lock:
            if len(self._records) + self._scenes_in_the_making >= self._settings.max_scenes:
                raise TooManyScenes(self._settings.max_scenes)
            self._scenes_in_the_making += 1
        seed = secrets.randbelow(MAX_SEED) if seed is None else seed
        scene = uuid.uuid4().hex[:12]
        command = CreateScene(scene, seed, now_utc(), image_size, names, count, light, stacked, is_measured)
        try:
            record: SceneRecord = self._simulation.call(command)
            with self._lock:
                self._store.save_scene(record)
                self._records[record.id] = record
        except CannotStore:
            self._simulation.submit(DropScene(scene))
            raise
        finally:
            with self._lock:
                self._scenes_in_the_making -= 1
        if is_shown:
            self.activate(record.id)
        return record

    def delete(self, scene: str) -> None:
        """Forget a scene; if it was shown, the latest other one is shown.

        Raises:
            UnknownName, SceneHeld: if there is none, or a job uses it.
        """
        self._check_free(scene)
        with self._lock:
            self.get(scene)
            self._store.delete_scene(scene)
            del self._records[scene]
            self._simulation.submit(DropScene(scene))
            if self._current == scene:
                self._show(next(reversed(self._records), None))

    def activate(self, scene: str) -> SceneRecord:
        """Show a scene in viewer and pages; raises UnknownName if there is none."""
        with self._lock:
            record = self.get(scene)
            self._show(scene)
            return record

    def reset(self, scene: str) -> SceneRecord:
        """Put a scene back to how it was created.

        Raises:
            UnknownName: if there is none.
            SceneHeld: if a job uses it.
            CannotStore: if the disk refuses; then it is as before.
        """
        self._check_free(scene)
        return self._change(ResetScene(scene), can_be_undone=True)

    def edit(self, scene: str, light: Light | None = None, poses: Poses = (), *, settle: bool = False) -> SceneRecord:
        """Move light and objects by hand, all or nothing.

        Args:
            scene: identifier.
            light: None for as it is.
            poses: T_world_object [m] of the objects to move, by name.
            settle: whether objects then come to rest as if let go.

        Raises:
            UnknownName: if there is no such scene or object.
            SceneHeld: if a job uses the scene.
            OsfError: if something would overlap or makes no sense; then nothing moves.
            CannotStore: if the disk refuses; then all is as before.
        """
        self._check_free(scene)
        _check_poses(poses)
        return self._change(EditScene(scene, light, poses, settle), can_be_undone=True)

    def act(self, scene: str, actions: Iterable[object]) -> SceneRecord:
        """Hold each velocity (vx, vy, 0) [m/s] for 0.2 s.

        Raises:
            UnknownName: if there is no such scene.
            SceneHeld: if a job uses it.
            InvalidInput: if a velocity is out of range; then nothing moves.
        """
        self._check_free(scene)
        return self._change(Act(scene, tuple(check_action(action) for action in actions)))

    async def image(self, command: TakeImage | TakeMask) -> bytes:
        """A PNG of a scene as it is now; asked for twice, it is made once.

        Raises:
            UnknownName: if there is no such scene, camera or object.
            InvalidInput: if the size is out of range.
        """
        image_side(command.size)
        return await self._images.image(command)

    def observe(self, scene: str, *, goal: bool, masks: bool) -> ObservedScene:
        """Return what the robot sees of a scene now, with the scene as it was then.

        Args:
            scene: identifier.
            goal: the goal camera's view alone, without the pusher.
            masks: whether to count each object's visible pixels.

        Raises:
            UnknownName: if there is no such scene.
            OsfError: if the simulation is not there now.
        """
        self.get(scene)
        return self._simulation.call(ObserveScene(scene, goal, masks))

    def compose(self, command: ComposeGoal) -> ComposedGoal:
        """How a scene could become, seen by the goal camera; the scene stays as it is.

        Raises:
            UnknownName, SceneHeld: if there is no such scene or object, or a job uses the scene.
            OsfError: if something would overlap, or makes no sense.
        """
        self.get(command.id)
        self._check_free(command.id)
        _check_poses(command.poses)
        image_side(command.size)
        return self._simulation.call(command)

    def disturb(self, command: Disturb | EditScene) -> Any:  # noqa: ANN401  each command says what answers it
        """Do something to a scene or its pictures, even while a job drives it.

        Raises:
            UnknownName: if there is no such scene or object.
            OsfError: if something would overlap; then nothing moves.
        """
        if isinstance(command, EditScene):
            return self._change(command)
        self.get(command.id)
        return self._simulation.call(command)

    def undo_disturbances(self, scene: str) -> None:
        """Put light and cameras back to how they are without `disturb`.

        Raises:
            OsfError: if the scene is gone, or the simulation is not there now.
        """
        self._simulation.call(UndoDisturbances(scene))

    def serve(self, command: JobCommand) -> Any:  # noqa: ANN401  each command says what answers it
        """Do what the job that drives a scene asks for.

        Raises:
            UnknownName: if there is no such scene.
            OsfError: if it cannot be done, or the simulation is not there now.
        """
        return self._change(command) if isinstance(command, Act) else self._simulation.call(command)

    def watch_frames(self, change: int) -> None:
        """Count `change` more (or less, if negative) listeners to live images."""
        with self._lock:
            before, self._watchers = self._watchers, max(self._watchers + change, 0)
            if (before > 0) != (self._watchers > 0):
                self._simulation.submit(WatchFrames(self._watchers > 0))

    # Inside

    def _change(self, command: ResetScene | EditScene | Act, *, can_be_undone: bool = False) -> SceneRecord:
        """Change a scene and store it.

        Args:
            command: what to do.
            can_be_undone: if the disk refuses. A push cannot, and must not be asked for twice: it is stored later.

        Raises:
            UnknownName: if there is no such scene.
            CannotStore: if the disk refuses, and the change was undone.
        """
        before = self.get(command.id)
        record: SceneRecord = self._simulation.call(command)
        with self._lock:
            latest = self._records.get(command.id)
            if latest is None:
                return record
            try:
                self._store.save_scene(latest, can_wait=not can_be_undone)
            except CannotStore:
                undone = replace(before, revision=latest.revision + 1)  # there are pictures of the revision between
                self._records[command.id] = undone
                self._simulation.submit(AdoptScene(undone))
                raise
        return record

    def _show(self, scene: str | None) -> None:
        self._current = scene
        self._store.set_current(scene)
        self._simulation.submit(ShowScene(scene))
        self._hub.publish(CurrentScene(None if scene is None else self._records[scene]))

    def _checked_names(self, names: tuple[str, ...] | None, poses: Poses | None) -> tuple[str, ...] | None:
        """The objects of a new scene, those of the poses if it has any; None for random ones."""
        if poses is not None:
            posed = tuple(name for name, _ in poses)
            if names is not None and set(names) != set(posed):
                raise InvalidInput("list of objects", ", ".join(names), "the objects that have poses, or left out")
            names = posed
        if names is not None:
            if not 1 <= len(names) <= MAX_OBJECTS:
                raise InvalidInput("number of objects", len(names), f"between 1 and {MAX_OBJECTS}")
            check_unique("list of objects", names)
            for name in names:
                self._library.check(name)
        return names

    def _check_free(self, scene: str) -> None:
        by = self._holder(scene)
        if by is not None:
            raise SceneHeld(by)

    def _greeting(self) -> list[Command]:
        with self._lock:
            adopt: list[Command] = [AdoptScene(record) for record in self._records.values()]
            return [*adopt, ShowScene(self._current), WatchFrames(self._watchers > 0)]

    def _on_simulation_event(self, event: SceneChanged | FramesTaken) -> None:
        if isinstance(event, SceneChanged):
            with self._lock:
                if event.record.id in self._records:
                    self._records[event.record.id] = event.record
        self._hub.publish(event)


def scene_or_current(scenes: Scenes, scene: str | None, without: type[OsfError]) -> SceneRecord:
    """One scene, by default the one that is shown.

    Args:
        scenes: of the service.
        scene: identifier; None for the current one.
        without: the error if none is named and none is shown.

    Raises:
        UnknownName: if there is none of this name.
    """
    scene = scene or scenes.current
    if scene is None:
        raise without
    return scenes.get(scene)


def _check_poses(poses: Poses) -> None:
    check_unique("list of objects", [name for name, _ in poses])
    _stacked(poses)


def _stacked(poses: Poses) -> Pose:
    """Poses as one batch, with quaternions checked."""
    stacked = Pose.stacked([pose for _, pose in poses])
    return Pose(stacked.position, unit_quaternion(stacked.quaternion, "quaternions"))


# Images of scenes, made once for everybody who asks for the same one


ImageKey = tuple[int, TakeImage | TakeMask]  # revision of the scene, and what is asked for


class SceneImages:
    """Asks for images and keeps them until their scene changes. Belongs to one event loop.

    Args:
        max_bytes: of the images that are kept.
        revision_of: returns the revision of a scene; raises UnknownName if there is none.
        take: makes an image of a scene as it is now.
    """

    def __init__(
        self,
        max_bytes: int,
        revision_of: Callable[[str], int],
        take: Callable[[TakeImage | TakeMask], Awaitable[bytes]],
    ) -> None:
        self._revision_of = revision_of
        self._take = take
        self._kept = ImageCache(max_bytes)
        self._in_the_making: dict[ImageKey, asyncio.Future[bytes]] = {}

    async def image(self, command: TakeImage | TakeMask) -> bytes:
        """A PNG of a scene as it is now.

        Raises:
            UnknownName: if there is no such scene.
            OsfError: if the image cannot be made.
        """
        key = (self._revision_of(command.id), command)
        images = self._kept.get(key)
        if images is not None:
            return images
        making = self._in_the_making.get(key)
        if making is None:
            making = asyncio.ensure_future(self._make(key))
            self._in_the_making[key] = making
            making.add_done_callback(lambda done: self._made(key, done))
        return await asyncio.shield(making)  # whoever asked first may leave, others still wait

    async def _make(self, key: ImageKey) -> bytes:
        revision, command = key
        image = await self._take(command)
        # After a change in between, what was made shows the later state, so it is not kept.
        if revision == self._revision_of(command.id):
            self._kept.put(key, image)
        return image

    def _made(self, key: ImageKey, done: asyncio.Future[bytes]) -> None:
        del self._in_the_making[key]
        if not done.cancelled():
            done.exception()  # taken note of, in case that everybody has left


class ImageCache:
    """The latest images, up to a number of bytes."""

    def __init__(self, max_bytes: int) -> None:
        self._max_bytes = max_bytes
        self._bytes = 0
        self._images: OrderedDict[object, bytes] = OrderedDict()
        self._lock = threading.Lock()

    def get(self, key: object) -> bytes | None:
        """An image, which then counts as new again; None if it is not kept."""
        with self._lock:
            if key in self._images:
                self._images.move_to_end(key)
            return self._images.get(key)

    def put(self, key: object, image: bytes) -> None:
        """Keep an image, in place of those that were asked for the longest time ago."""
        with self._lock:
            self._bytes += len(image) - len(self._images.get(key, b""))
            self._images[key] = image
            while self._bytes > self._max_bytes:
                _, dropped = self._images.popitem(last=False)
                self._bytes -= len(dropped)
