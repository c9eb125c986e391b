"""A world whose pusher stays within limits, asks before its first motion, and can be stopped at any time."""

from __future__ import annotations

import contextlib
import threading
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass, replace
from itertools import chain

import numpy as np
from jaxtyping import Float

from osfcore.contrib.robots.robot import RobotStopped, SafetyLimits, Stoppable, Whereabouts
from osfcore.control.world import World, without_cameras
from osfcore.errors import InvalidInput, OsfError, check_known
from osfcore.estimation.camera_response import srgb_of_linear
from osfcore.geometry.states import Observation
from osfcore.geometry.workspace import STEP_S, check_action
from osfcore.io.image_file import to_uint8
from osfcore.photo.segmentation import Box, propose_masks

_OVERSHOT_M = 0.01  # a pusher may have come so far outside the box by itself, and returns


@dataclass(frozen=True, eq=False, slots=True)
class HeldBack:
    """An action that a wall of the box cut short.

    Attributes:
        action: as asked for [m/s].
        done: the part that was done, as a velocity held for as long [m/s].
    """

    action: Float[np.ndarray, "3"]
    done: Float[np.ndarray, "3"]


class GuardedWorld:
    """A wrapper of any `World` that enforces limits.

    An action above the top speed is done slower, for longer, along the same path. A path out of the box ends at its
    wall. Between two observations the pusher may be wherever its actions can have brought it; no such place is outside.

    `stop`, `close` and any error while the robot looks or moves stop it. After that `act` only raises `RobotStopped`.

    Args:
        world: that is moved; started and stopped if it is `Stoppable`.
        limits: for the pusher.
        permit: asked once, before the first motion; nothing moves unless it returns True.
    """

    def __init__(self, world: World, limits: SafetyLimits, permit: Callable[[], bool] | None = None) -> None:
        self._world, self._limits, self._permit = world, limits, permit
        self._where: Whereabouts | None = None
        self._reason = ""
        self._stopped = threading.Event()
        self._lock = threading.Lock()
        self._is_started = False
        self._held_back: list[HeldBack] = []

    @property
    def held_back(self) -> tuple[HeldBack, ...]:
        """Actions that were cut short so far."""
        return tuple(self._held_back)

    def check(self) -> None:
        """Raise if the robot was stopped.

        Raises:
            RobotStopped: if so.
        """
        if self._stopped.is_set():
            raise RobotStopped(self._reason)

    def stop(self, reason: str) -> None:
        """Stop the robot for good; from any thread, any number of times.

        Args:
            reason: why, as the end of the sentence "The robot was stopped: ...".
        """
        with self._lock:
            self._reason = self._reason or reason
        self._stopped.set()  # before the robot is stopped: a thread about to send an action sees it
        self._stop_world()

    # The World protocol

    def reset(self, seed: int) -> Observation:
        """Reset the wrapped world."""
        with self._halted_by_errors():
            return self._seen(self._world.reset(seed))

    def observe(self, *, masks: bool = False) -> Observation:
        """Observe the wrapped world; also after a stop."""
        with self._halted_by_errors():
            return self._seen(self._world.observe(masks=masks))

    def act(self, action: Float[np.ndarray, "3"]) -> None:
        """Do as much of an action as the limits allow.

        Raises:
            InvalidInput: if it is no action, or the pusher's place is unknown or well outside the box; nothing moves.
            RobotStopped: if the robot was stopped, before or meanwhile, or may not move.
        """
        action = check_action(action)
        wanted = action[:2] * STEP_S
        self.check()
        where = self._where
        if where is None:
            raise InvalidInput("place of the pusher", "unknown", "told by the robot before it is moved")
        if self._limits.outside_m(where) > _OVERSHOT_M:
            allowed = f"within {self._limits.box}, the safety box; move it there by hand, or allow a larger box"
            raise InvalidInput("place of the pusher [m]", np.round(where.low, 3).tolist(), allowed)
        travel = self._limits.allowed_travel(wanted, where)
        if not np.allclose(travel, wanted, atol=1e-6):
            self._held_back.append(HeldBack(action, np.array([*(travel / STEP_S), 0.0])))
        self._begin()
        self._where = where.after(travel)
        for velocity in self._limits.slow_parts(travel):
            self.check()
            with self._halted_by_errors():
                self._world.act(velocity)
        self.check()

    def close(self) -> None:
        """Stop the robot and release what the wrapped world holds."""
        if self._is_started:
            self.stop("it was let go")
        self._world.close()

    def _seen(self, observation: Observation) -> Observation:
        self._where = None if observation.pusher is None else Whereabouts.at(observation.pusher)
        return observation

    def _begin(self) -> None:
        """Ask for permission and start the robot, once."""
        if self._is_started:
            return
        if self._permit is not None and not self._permit():
            self.stop("nobody allowed it to move")
        self.check()
        self._is_started = True
        if isinstance(self._world, Stoppable):
            with self._halted_by_errors():
                self._world.start()
            if self._stopped.is_set():  # meanwhile, and the start came after it
                self._stop_world()

    @contextlib.contextmanager
    def _halted_by_errors(self) -> Iterator[None]:
        """Stop the robot on any error, also on an interruption by the keyboard."""
        try:
            yield
        except BaseException as error:
            was_stopped = self._stopped.is_set()
            if self._is_started:
                self.stop(str(error) or "it was interrupted")
            if was_stopped and isinstance(error, OsfError):  # a stopped robot refuses late commands
                raise RobotStopped(self._reason) from error
            raise

    def _stop_world(self) -> None:
        if isinstance(self._world, Stoppable):
            with contextlib.suppress(OsfError):  # one that cannot be reached halts by itself
                self._world.stop()


# Masks of the first observation for worlds without: a person draws a box around each object, GrabCut its outline.

CameraBoxes = Mapping[str, Mapping[str, Box]]


class OutlinedWorld:
    """A wrapper of a world without masks, which takes them from boxes.

    Args:
        world: that looks and moves.
        boxes: by names of camera and object, x0, y0, x1, y1 [px] of the images of `observe`. Cameras in which an object
            has none are left out of observations with masks: no mask would mean that it is not visible there.
    """

    def __init__(self, world: World, boxes: CameraBoxes) -> None:
        self._world, self._boxes = world, boxes
        self.reset, self.act, self.close = world.reset, world.act, world.close

    def observe(self, *, masks: bool = False) -> Observation:
        """Observe the wrapped world, with outlines on demand.

        Raises:
            UnknownName: if a box is in no camera, or around no object, that there is.
            InvalidInput: if no camera has a box around each object, or nothing is found in one.
        """
        seen = self._world.observe(masks=masks)
        if not masks or seen.masks is not None:
            return seen
        cameras = [camera.name for camera in seen.cameras]
        check_known("camera", self._boxes, cameras)
        check_known("object on the table", chain.from_iterable(self._boxes.values()), seen.names)
        unmarked = frozenset(camera for camera in cameras if set(self._boxes.get(camera, ())) != set(seen.names))
        if len(unmarked) == len(cameras):
            allowed = "around each object in at least one camera, for the robot delivers no masks"
            raise InvalidInput("boxes", "missing", allowed)
        marked = without_cameras(seen, unmarked)
        pictures = [to_uint8(srgb_of_linear(image)) for image in marked.images]
        pairs = zip(marked.cameras, pictures, strict=True)
        found = []
        for camera, picture in pairs:  # a click in a box's middle marks the object, and background of the others
            boxes = self._boxes[camera.name]
            clicks = {name: np.array([[(x0 + x1) / 2, (y0 + y1) / 2]]) for name, (x0, y0, x1, y1) in boxes.items()}
            masks_of = propose_masks(picture, boxes, clicks)
            found.append([masks_of[name] for name in seen.names])
        return replace(marked, masks=np.array(found))
