"""A world that keeps its pusher within limits, asks before the first motion, and can be stopped at any time."""

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
from osfcore.photo.segmentation import Box, outline_doubt, propose_masks

_OUTSIDE_M = 0.01  # a pusher may have come so far outside the box by itself, and returns

# How far the reported position of the pusher may differ from the commanded one.
_PLACE_ERROR_M = 0.01  # of a measured place: calibration, and the give of an arm that pushes
_OVERSHOT_SHARE = 0.5  # of a motion: a controller may go on for 0.1 s after each 0.2 s
_FELT_M = 0.005  # shorter motions say nothing of whether it moves: a measured place trembles
_LEAST_SHARE = 1 / 3  # of a motion that is done: a controller that needs 0.1 s to speed up does half of each 0.2 s
_HELD_M = 0.1  # of motions in a row of which less was done: an object may hold the pusher for one, but not for ever


@dataclass(frozen=True, eq=False, slots=True)
class HeldBack:
    """An action that was shortened at a wall of the safety box.

    Attributes:
        action: the commanded velocity [m/s].
        done: the executed part, as a velocity held for the same time [m/s].
    """

    action: Float[np.ndarray, "3"]
    done: Float[np.ndarray, "3"]


class GuardedWorld:
    """A wrapper of any `World` that enforces limits.

    An action above the top speed is executed more slowly, for a longer time, along the same path. A path out of the box
    ends at its wall. All places that the pusher can have reached between two observations are inside the box.

    Each position that the robot reports is compared with the commands since the last one. The robot is stopped if its
    pusher is where no part of the commands leads. If the pusher has moved less than a third of the commanded way, an
    object may hold it, or its position may not be measured. It then counts as being anywhere on the way until it is
    seen to move. It is stopped after 10 cm.

    `stop`, `close`, and any error of the robot stop it. After that, `act` raises `RobotStopped`.

    Args:
        world: the world to guard. It is started and stopped if it is `Stoppable`.
        limits: limits of the pusher.
        permit: function that is called once before the first motion. Nothing moves unless it returns True.
    """

    def __init__(self, world: World, limits: SafetyLimits, permit: Callable[[], bool] | None = None) -> None:
        self._world, self._limits, self._permit = world, limits, permit
        self._where: Whereabouts | None = None
        self._seen_at = np.zeros(2)  # where the robot said last that the pusher is [m]
        self._asked = self._wished = np.zeros(2)  # travel since, and what it would be were that place certain [m]
        self._way_m = 0.0  # length of all travels since
        self._unmoved_m = 0.0  # travel asked for since the pusher was last seen to move
        self._reason = ""
        self._stopped = threading.Event()
        self._lock = threading.Lock()
        self._is_started = False
        self._held_back: list[HeldBack] = []

    @property
    def held_back(self) -> tuple[HeldBack, ...]:
        """Actions that were shortened so far."""
        return tuple(self._held_back)

    def check(self) -> None:
        """Check that the robot was not stopped.

        Raises:
            RobotStopped: if it was.
        """
        if self._stopped.is_set():
            raise RobotStopped(self._reason)

    def stop(self, reason: str) -> None:
        """Stop the robot for good. Any thread may call this, any number of times.

        Args:
            reason: why, as the end of the sentence "The robot was stopped: ...".
        """
        with self._lock:
            self._reason = self._reason or reason
        self._stopped.set()  # before the robot is stopped: a thread about to send an action sees it
        self._stop_world()

    # The World protocol

    def reset(self, seed: int) -> Observation:
        """Reset the wrapped world. A robot only observes; its pusher is checked as in `observe`."""
        with self._halted_by_errors():
            seen = self._world.reset(seed)
        if isinstance(self._world, Stoppable):
            self._take_place(seen.pusher)
        else:
            self._locate(seen.pusher)
        return seen

    def observe(self, *, masks: bool = False) -> Observation:
        """Observe the wrapped world. This works after a stop as well.

        Raises:
            RobotStopped: if the pusher is not where its commands lead.
        """
        with self._halted_by_errors():
            seen = self._world.observe(masks=masks)
        self._take_place(seen.pusher)
        return seen

    def act(self, action: Float[np.ndarray, "3"]) -> None:
        """Execute as much of an action as the limits allow.

        Raises:
            InvalidInput: if it is no action, or the pusher's position is unknown or well outside the box. Nothing
                moves.
            RobotStopped: if the robot was stopped before or during the action, or may not move.
        """
        action = check_action(action)
        wanted = action[:2] * STEP_S
        self.check()
        where = self._where
        if where is None:
            raise InvalidInput("position of the pusher", "unknown", "reported by the robot before it moves")
        if self._limits.outside_m(where) > _OUTSIDE_M:
            allowed = f"within {self._limits.box}, the safety box; move the pusher there by hand, or allow a larger box"
            raise InvalidInput("position of the pusher [m]", np.round(where.low, 3).tolist(), allowed)
        travel = self._limits.allowed_travel(wanted, where)
        if not np.allclose(travel, wanted, atol=1e-6):
            self._held_back.append(HeldBack(action, np.array([*(travel / STEP_S), 0.0])))
        self._begin()
        self._where, self._asked = where.after(travel), self._asked + travel
        self._way_m += float(np.linalg.norm(travel))
        self._wished = self._wished + self._limits.allowed_travel(wanted, Whereabouts.at(self._seen_at))
        for velocity in self._limits.slow_parts(travel):
            self.check()
            with self._halted_by_errors():
                self._world.act(velocity)
        self.check()

    def close(self) -> None:
        """Stop the robot and release what the wrapped world holds."""
        if self._is_started:
            self.stop("the connection was closed")
        self._world.close()

    def _locate(self, pusher: Float[np.ndarray, "3"] | None) -> None:
        """Set the pusher's position to the one that the robot reports."""
        self._where, self._unmoved_m = None if pusher is None else Whereabouts.at(pusher), 0.0
        if pusher is not None:
            self._compare_from(pusher)

    def _compare_from(self, pusher: Float[np.ndarray, "3"]) -> None:
        self._seen_at, self._way_m = pusher[:2].astype(float), 0.0
        self._asked = self._wished = np.zeros(2)

    def _take_place(self, pusher: Float[np.ndarray, "3"] | None) -> None:
        """Compare the reported position with the commands; stop the robot if they contradict each other.

        Raises:
            RobotStopped: if they do.
        """
        where = self._where
        if pusher is None or where is None or not self._is_started or self._stopped.is_set():
            self._locate(pusher)  # there is nothing to compare
            return
        off_m = where.distance_m(pusher[:2])
        if off_m > _PLACE_ERROR_M + _OVERSHOT_SHARE * self._way_m:
            off = f"its pusher is {1000 * off_m:.0f} mm away from its commanded path"
            self.stop(f"{off}; check whether something moved it, and whether positions and velocities share axes")
            self.check()
        asked_m, wished_m = float(np.linalg.norm(self._asked)), float(np.linalg.norm(self._wished))
        if max(asked_m, wished_m) < _FELT_M:  # wait for more
            self._where = where.with_place(pusher[:2])
            return
        moved_m = float((pusher[:2] - self._seen_at) @ self._asked) / max(asked_m, _FELT_M)
        if asked_m >= _FELT_M and moved_m >= _LEAST_SHARE * asked_m:
            self._locate(pusher)
            return
        # It may have reached a wall unseen and stopped there. Then only the wished travel is left to compare.
        self._where, self._unmoved_m = where.with_place(pusher[:2]), self._unmoved_m + max(asked_m, wished_m)
        if self._unmoved_m > _HELD_M:
            unmoved = f"its pusher hardly moved although it was commanded {1000 * self._unmoved_m:.0f} mm"
            self.stop(f"{unmoved}; check whether something holds it, and whether its position is measured")
            self.check()
        self._compare_from(pusher)

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
        """Stop the robot on any error, including an interruption by the keyboard."""
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
            with contextlib.suppress(Exception):  # one that cannot be reached halts by itself; a stop never fails
                self._world.stop()


# Masks of the first observation for worlds without masks: a person draws a box around each object; GrabCut segments it.

CameraBoxes = Mapping[str, Mapping[str, Box]]


class OutlinedWorld:
    """A wrapper of a world without masks, which takes them from boxes.

    Args:
        world: the wrapped world.
        boxes: boxes (x0, y0, x1, y1) [px] in the images of `observe`, by names of camera and object. A camera without a
            box for each object is left out of observations with masks, since a missing mask would mean that the object
            is not visible.

    Attributes:
        doubts: a sentence for each outline of the last observation that does not fill its box.
    """

    def __init__(self, world: World, boxes: CameraBoxes) -> None:
        self._world, self._boxes = world, boxes
        self.doubts: tuple[str, ...] = ()
        self.reset, self.act, self.close = world.reset, world.act, world.close

    def observe(self, *, masks: bool = False) -> Observation:
        """Observe the wrapped world; with `masks`, segment the objects in their boxes.

        Raises:
            UnknownName: if a box names a camera or an object that does not exist.
            InvalidInput: if no camera has a box around each object, or nothing is found in a box.
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
        found, doubts = [], []
        for camera, image in zip(marked.cameras, marked.images, strict=True):
            boxes = self._boxes[camera.name]
            # A click in a box's middle marks the object, and background of the others.
            clicks = {name: np.array([[(x0 + x1) / 2, (y0 + y1) / 2]]) for name, (x0, y0, x1, y1) in boxes.items()}
            masks_of = propose_masks(to_uint8(srgb_of_linear(image)), boxes, clicks)
            found.append([masks_of[name] for name in seen.names])
            names = {name: f"{name} in the picture of {camera.name}" for name in seen.names}
            doubts += [outline_doubt(names[name], boxes[name], masks_of[name]) for name in seen.names]
        self.doubts = tuple(doubt for doubt in doubts if doubt)
        return replace(marked, masks=np.array(found))
