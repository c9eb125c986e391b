"""The simulation's process: holds the scenes, carries out commands, reports what moves and what the cameras see.

The service imports only `simulation_main`; physics and ray tracing load in the child.
"""

from __future__ import annotations

import logging
import os
import time
from collections import OrderedDict, defaultdict, deque
from collections.abc import Callable, Iterator
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from osfcore.errors import NotThere, OsfError, check_known
from osfcore.geometry.cameras import default_cameras, goal_camera, image_side
from osfcore.geometry.light import Light
from osfcore.geometry.poses import Pose
from osfcore.geometry.states import Observation, SceneState
from osfcore.geometry.workspace import STEP_S, check_action
from osfcore.inspection.overlays import tint_masks
from osfcore.io.image_file import encode_jpeg, encode_png, to_uint8
from osfcore.objects.asset_library import AssetLibrary
from osfcore.random_streams import Stream, stream_rng

from .child_process import import_quietly
from .messages.scene_messages import (
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
    ObservedScene,
    ObserveScene,
    ResetScene,
    SceneChanged,
    SceneRecord,
    ShowScene,
    TakeImage,
    TakeMask,
    TakeView,
    UndoDisturbances,
    WatchFrames,
)
from .render_cameras import scene_camera
from .server import IsOvertaken, ProcessServer

if TYPE_CHECKING:
    from osfcore.world.scenes import SceneRequest
    from osfcore.world.simulators import Simulator
    from osfcore.world.tabletop import Tabletop

STATES_HZ = 60.0
FRAME_INTERVAL_S = 0.2
MAX_FRAME_SIDE = 192  # live images larger than this cost more than they show
_log = logging.getLogger(__name__)


def simulation_main(server: ProcessServer, objects_root: Path, max_live_worlds: int, simulator: Simulator) -> None:
    """Carry out commands until the service has gone; `server` is the pipe to it, the others as in `Simulation`."""
    import_quietly("osfcore.world.tabletop")  # slow, so before the simulation calls itself ready
    with ThreadPoolExecutor(os.cpu_count() or 1) as executor:
        simulation = Simulation(server.send, AssetLibrary(objects_root), executor, max_live_worlds, simulator)
        try:
            server.serve(simulation.carry_out, idle=simulation.idle)
        finally:
            simulation.close()


class Simulation:
    """Scenes by identifier; the latest few have a live simulation, the others are loaded when needed.

    Args:
        send: takes events.
        library: the objects.
        executor: for ray tracing.
        max_live_worlds: scenes whose simulation stays in memory.
        simulator: moves the objects.
    """

    def __init__(
        self,
        send: Callable[[object], None],
        library: AssetLibrary,
        executor: ThreadPoolExecutor,
        max_live_worlds: int,
        simulator: Simulator,
    ) -> None:
        self._send = send
        self._library = library
        self._executor = executor
        self._max_live_worlds = max_live_worlds
        self._simulator: Simulator = simulator
        self._records: dict[str, SceneRecord] = {}
        self._worlds: OrderedDict[str, Tabletop] = OrderedDict()
        self._time_offsets: dict[str, float] = {}
        self._disturbances: defaultdict[str, Disturbance] = defaultdict(Disturbance)
        self._shown: str | None = None
        self._frames_wanted = False
        self._frames_due = False
        self._last_frames = 0.0
        self._last_lag_s = 0.0

    def idle(self, is_busy: bool) -> float | None:
        """Take live images if they are due; returns the time until they are [s], None if no image is wanted.

        While commands wait they are due three times as seldom, but a page that keeps pushing does not starve them.
        """
        if not (self._frames_due and self._frames_wanted):
            return None
        left_s = self._last_frames + FRAME_INTERVAL_S * (3 if is_busy else 1) - time.monotonic()
        if left_s > 0:
            return left_s
        self._take_frames()
        return None

    def close(self) -> None:
        """Free all simulations."""
        for world in self._worlds.values():
            world.close()
        self._worlds.clear()

    def carry_out(self, command: Command, is_overtaken: IsOvertaken = lambda: False) -> object:
        """What answers a command.

        Raises:
            OsfError: if it cannot be done; then nothing has changed.
        """
        del is_overtaken  # commands change scenes, so none is left out
        try:
            return self._dispatch(command)
        except OsfError:
            raise
        except Exception:  # a defect: the simulation may be in any state, so it is loaded afresh from the last record
            self._forget_world(getattr(command, "id", ""))
            raise

    def _dispatch(self, command: Command) -> object:
        match command:
            case CreateScene():
                return self._create(command)
            case AdoptScene(record):
                if record.id in self._records:
                    self._forget_world(record.id)
                    self._tell(record)
                self._records[record.id] = record
                return record
            case DropScene(scene):
                self._records.pop(scene, None)
                self._disturbances.pop(scene, None)
                self._forget_world(scene)
            case ResetScene(scene):
                record = self._record(scene)
                self._disturbances.pop(scene, None)
                self._world(scene).load(record.initial)
                self._time_offsets[scene] = 0.0
                return self._report(record)
            case EditScene():
                return self._edit(command)
            case Act(scene, actions):
                return self._act(scene, tuple(check_action(a) for a in actions))
            case Disturb(scene, camera):
                self._report(self._record(scene))  # new pictures are due
                self._disturbances[scene] = self._disturbances[scene].toggled(camera)
                return self._disturbances[scene]
            case UndoDisturbances(scene):
                if self._disturbances.pop(scene, Disturbance()) != Disturbance():
                    self._report(self._record(scene))
            case TakeImage():
                return image_png(self._world(command.id), command)
            case TakeView(scene, camera, pusher):
                return to_uint8(self._world(scene).render((camera,), with_pusher=pusher).images[0])
            case TakeMask():
                return mask_png(self._world(command.id), command)
            case ObserveScene():
                return self._observe(command)
            case ComposeGoal():
                return self._compose(command)
            case ShowScene(scene):
                self._shown = scene
                self._frames_due = scene is not None
            case WatchFrames(wanted):
                self._frames_wanted = wanted
                self._frames_due = self._frames_due or wanted
        return None

    def _record(self, scene: str) -> SceneRecord:
        if scene not in self._records:
            raise NotThere("scene")
        return self._records[scene]

    # Worlds

    def _create(self, command: CreateScene) -> SceneRecord:
        from osfcore.world.scenes import SceneRequest

        world = self._table(SceneRequest(command.names, command.count, command.light))
        try:
            if command.poses is None:
                world.arrange(command.seed)
            else:
                light = command.light or Light.random(stream_rng(command.seed, Stream.LIGHT))
                state = SceneState(command.names or (), command.poses, light, None)
                (world.load_measured if command.is_measured else world.load)(state)
                if command.is_measured:
                    deque(world.settle(), maxlen=0)
        except BaseException:
            world.close()
            raise
        state = world.truth()
        record = SceneRecord(
            command.id, command.seed, command.created_at, command.image_size, state, state, time_s=0.0, revision=1
        )
        self._keep_world(record.id, world, time_offset_s=0.0)
        self._tell(record)
        return record

    def _world(self, scene: str) -> Tabletop:
        """The scene's simulation, loaded from its record if it is not in memory."""
        from osfcore.world.scenes import SceneRequest

        record = self._record(scene)
        if scene in self._worlds:
            self._worlds.move_to_end(scene)
            return self._worlds[scene]
        world = self._table(SceneRequest(record.state.names))
        world.restore(record.state)
        self._keep_world(scene, world, time_offset_s=record.time_s)
        return world

    def _table(self, request: SceneRequest) -> Tabletop:
        from osfcore.world.scenes import Conditions
        from osfcore.world.tabletop import Tabletop

        conditions = Conditions(simulator=self._simulator)
        return Tabletop(self._library, request=request, conditions=conditions, executor=self._executor)

    def _keep_world(self, scene: str, world: Tabletop, *, time_offset_s: float) -> None:
        self._worlds[scene] = world
        self._time_offsets[scene] = time_offset_s
        while len(self._worlds) > self._max_live_worlds:
            self._forget_world(next(iter(self._worlds)))

    def _forget_world(self, scene: str) -> None:
        world = self._worlds.pop(scene, None)
        self._time_offsets.pop(scene, None)
        if world is not None:
            world.close()

    # Changes

    def _edit(self, command: EditScene) -> SceneRecord:
        record, world = self._record(command.id), self._world(command.id)
        if command.poses:
            self._move(world, record, dict(command.poses))
        if command.light is not None:
            world.set_light(command.light)
        if command.settle:
            self._report(record)  # the jump; from there they fall
            self._stream(record.id, world.settle(rate_hz=STATES_HZ), 1 / STATES_HZ)
        return self._report(record)

    def _move(self, world: Tabletop, record: SceneRecord, poses: dict[str, Pose]) -> None:
        """Put objects somewhere else, all at once, so that two may swap places."""
        if len(poses) == 1:
            ((name, pose),) = poses.items()
            world.move_object(name, pose)
            return
        state, time_s = world.truth(), self._time_s(record.id)
        check_known("object on the table", poses, state.names)
        every = [poses.get(name, state.pose(name)) for name in state.names]
        world.load(replace(state, poses=Pose.stacked(every)))
        self._time_offsets[record.id] = time_s

    def _act(self, scene: str, actions: tuple[np.ndarray, ...]) -> SceneRecord:
        world, record = self._world(scene), self._record(scene)
        for action in actions:
            record = self._stream(scene, world.act_steps(action, rate_hz=STATES_HZ), 0.0)
            if time.monotonic() - self._last_frames > FRAME_INTERVAL_S + self._last_lag_s:
                self._take_frames()
        return record

    def _stream(self, scene: str, steps: Iterator[SceneState], interval_s: float) -> SceneRecord:
        """Run through the steps, then report all of them; an interval of 0 spreads them over one action."""
        states = tuple(steps)
        return self._report(self._record(scene), states, interval_s or STEP_S / max(len(states), 1))

    def _report(self, record: SceneRecord, states: tuple[SceneState, ...] = (), interval_s: float = 0.0) -> SceneRecord:
        state, time_s = self._world(record.id).truth(), self._time_s(record.id)
        changed = replace(record, state=state, time_s=time_s, revision=self._record(record.id).revision + 1)
        self._tell(changed, states, interval_s)
        return changed

    def _tell(self, record: SceneRecord, states: tuple[SceneState, ...] = (), interval_s: float = 0.0) -> None:
        self._records[record.id] = record
        self._send(SceneChanged(record, states, interval_s))
        self._frames_due = self._frames_due or record.id == self._shown

    def _time_s(self, scene: str) -> float:
        return self._time_offsets[scene] + self._worlds[scene].time_s

    # Pictures

    def _observe(self, command: ObserveScene) -> ObservedScene:
        record, world = self._record(command.id), self._world(command.id)
        cameras = (goal_camera(record.image_size),) if command.goal else default_cameras(record.image_size)
        observation = world.render(cameras, masks=command.masks, with_pusher=not command.goal)
        if not command.goal:
            observation = self._disturbances[command.id].apply(observation)
        images = to_uint8(observation.images).astype(np.float32) / 255  # as cameras deliver them
        return ObservedScene(replace(record, state=world.truth()), replace(observation, images=images))

    def _compose(self, command: ComposeGoal) -> ComposedGoal:
        from osfcore.world.tasks import arranged_goal, random_goal

        world, time_s = self._world(command.id), self._time_s(command.id)
        try:
            if command.seed is not None:
                goal, _ = random_goal(world, command.seed, command.moved)
            else:
                goal = arranged_goal(world, dict(command.poses), is_measured=command.is_measured)
            if command.light is not None:
                world.set_light(command.light)
            image = world.render((goal_camera(image_side(command.size)),), with_pusher=False).images[0]
        finally:
            world.restore(self._record(command.id).state)
            self._time_offsets[command.id] = time_s
        poses = tuple((name, goal.pose(name)) for name in goal.names)
        return ComposedGoal(encode_png(to_uint8(image)), poses)

    def _take_frames(self) -> None:
        """Send the shown scene's live images if they are wanted and stale."""
        if not (self._frames_due and self._frames_wanted) or self._shown not in self._records:
            self._frames_due = self._frames_due and self._shown in self._records
            return
        start = time.monotonic()
        self._frames_due = False
        record = self._records[self._shown]
        try:
            cameras = default_cameras(min(record.image_size, MAX_FRAME_SIDE))
            observation = self._disturbances[record.id].apply(self._world(record.id).render(cameras))
        except OsfError as error:
            _log.warning("no live images of scene %s: %s", record.id, error)
            return
        images = to_uint8(observation.images)
        jpegs = tuple(encode_jpeg(image) for image in images)
        names = tuple(camera.name for camera in observation.cameras)
        self._send(FramesTaken(record.id, record.revision, names, images, jpegs))
        self._last_frames = time.monotonic()
        self._last_lag_s = self._last_frames - start


# Pictures of a scene, encoded as PNG


def image_png(world: Tabletop, command: TakeImage) -> bytes:
    """What one camera sees, with the objects' masks laid over it on demand.

    Raises:
        UnknownName: if there is no such camera.
    """
    camera = scene_camera(command.camera, command.size)
    observation = world.render((camera,), masks=command.masks, with_pusher=command.pusher)
    pixels = to_uint8(observation.images[0])
    return encode_png(pixels if observation.masks is None else tint_masks(pixels, observation.masks[0]))


def mask_png(world: Tabletop, command: TakeMask) -> bytes:
    """The visible pixels of one object, 0 and 255.

    Raises:
        UnknownName: if there is no such camera or object.
    """
    camera = scene_camera(command.camera, command.size)
    check_known("object on the table", [command.object], world.names)
    masks = world.render((camera,), masks=True).masks
    assert masks is not None, "they are asked for"
    return encode_png(masks[0][world.names.index(command.object)].astype(np.uint8) * 255)


# What people do to the pictures of a scene to see whether the program notices: dim the light, cover a camera


DIMMED = 0.45


@dataclass(frozen=True, slots=True)
class Disturbance:
    """What is done to a scene's pictures, until its episode ends, it is put back, or the simulation starts again.

    Attributes:
        brightness: factor of all radiance, ambient light included, as a dimmed lamp in a dark room has it.
        covered: names of cameras that see black.
    """

    brightness: float = 1.0
    covered: frozenset[str] = frozenset()

    def apply(self, observation: Observation) -> Observation:
        """The observation as it is with this."""
        if self == Disturbance():
            return observation
        images = observation.images * np.float32(self.brightness)
        for view, camera in enumerate(observation.cameras):
            if camera.name in self.covered:
                images[view] = 0
        return replace(observation, images=images)

    def toggled(self, camera: str | None) -> Disturbance:
        """Cover a camera, or dim the light for None; undo it where that, or any camera, is so already."""
        if camera is None:
            return replace(self, brightness=DIMMED if self.brightness == 1.0 else 1.0)
        return replace(self, covered=frozenset() if self.covered else frozenset({camera}))
