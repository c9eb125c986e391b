"""`osf robot`: see whether a robot's cameras are where it says, and drive it toward a goal photo."""

from __future__ import annotations

import contextlib
import os
import select
import sys
import threading
import time
from collections.abc import Callable, Iterator
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal

import tyro

from osfcore.errors import InvalidInput, check_seed, shown
from osfcore.io.output_paths import check_place

from .command import Command, DataCommand, Device, choice_of

if TYPE_CHECKING:
    from osfcore.contrib.robots.guarded_world import CameraBoxes
    from osfcore.contrib.robots.robot import Robot, RobotDescription
    from osfcore.geometry.states import Observation

    from ..episodes.robot import RobotDrive

_LOOKS = 3
_LISTENS_EVERY_S = 0.05
_FORM = "CAMERA:NAME:LEFT,TOP,RIGHT,BOTTOM, such as left:025_mug:120,80,260,210"


@dataclass(frozen=True)
class RobotCheck(Command):
    """Look through a robot's cameras without moving it: do the table's axes lie where they should?"""

    url: tyro.conf.Positional[str]
    """http://HOST:PORT, or ros://HOST:9090?cameras=NAME,NAME for rosbridge."""
    out: Path | None = None
    """Folder for overlay.png, with the axes drawn into all pictures, and a picture of each camera, CAMERA.png."""

    def run(self) -> dict[str, Any]:
        """Look some times; the result has cameras, limits and how long a look takes."""
        from osfcore.contrib.robots.connect import connect

        from ..episodes.robot import doubts_about

        overlay = None if self.out is None else self.out / "overlay.png"
        if overlay is not None:
            check_place(overlay)
        with contextlib.closing(connect(self.url)) as robot:
            looks = [_timed_look(robot) for _ in range(_LOOKS)]
        seen, seconds = looks[-1][0], [look[1] for look in looks]
        about, doubts = robot.description, doubts_about(robot.description)
        if overlay is not None:
            _write_pictures(overlay, seen)
        self.say(*self._described(about, seen, min(seconds)), *doubts)
        if overlay is not None:
            self.say(f"{overlay}: the axes must stand in the middle of the table, the yellow stroke in the pusher.")
        assert seen.pusher is not None
        return {
            "robot": self.url, "cameras": [camera.name for camera in seen.cameras], "limits": asdict(about.limits),
            "pusher": seen.pusher.tolist(), "pusher_radius_m": about.pusher_radius_m, "deadman_s": about.deadman_s,
            "look_s": [round(each, 4) for each in seconds], "doubts": list(doubts),
        }  # fmt: skip

    def _described(self, about: RobotDescription, seen: Observation, look_s: float) -> Iterator[str]:
        assert seen.pusher is not None
        names = ", ".join(camera.name for camera in seen.cameras)
        height, width = seen.images.shape[1:3]
        x0, y0, x1, y1 = about.limits.box
        x, y, _ = seen.pusher
        cameras = f"{len(seen.cameras)} cameras ({names}; {width} x {height})"
        yield f"The robot at {self.url} has {cameras}; a look: {look_s:.2f} s."
        yield f"Its pusher is at x {x:.3f}, y {y:.3f} m and stays within x {x0:g} to {x1:g}, y {y0:g} to {y1:g} m,"
        speed = about.limits.top_speed_m_s
        yield f"no faster than {speed:g} m/s; without a command it halts after {about.deadman_s:g} s."


@dataclass(frozen=True)
class RobotDriveCommand(DataCommand):
    """Push objects on a robot's table until it looks like a photo. It asks before it moves; any key stops it."""

    url: tyro.conf.Positional[str]
    """http://HOST:PORT, or ros://HOST:9090?cameras=NAME,NAME for rosbridge."""
    goal: Path
    """Photo of how the table should look, by one of the robot's cameras, without the pusher."""
    names: tuple[str, ...]
    """Objects on the table."""
    out: Path
    """Folder for report.json, goal.png, frames/ and video.mp4."""
    goal_camera: str | None = None
    """The camera that took the goal; that by whose name the file is called without it."""
    goal_encoding: Literal["srgb", "linear"] = "srgb"
    """Of the goal: as cameras write, or radiance as it is."""
    boxes: tuple[str, ...] = ()
    """CAMERA:NAME:LEFT,TOP,RIGHT,BOTTOM [px] as the table lies now, where the robot delivers no masks; of each object
    in at least one camera, in the pictures of `osf robot check`."""
    box: tuple[float, float, float, float] | None = None
    """x0 y0 x1 y1 [m] that the pusher's centre stays in, besides the robot's own; 0.35 m to each side without it."""
    top_speed: float = 0.1
    """Of the pusher [m/s]; actions take longer where it is low."""
    yes: bool = False
    """Do not ask before the first motion."""
    steps: int = 100
    """Actions at most, counted anew after each disturbance that is noticed."""
    samples: int = 160
    """Sequences of actions in each of a plan's two rounds."""
    horizon: int = 30
    """Actions in each."""
    seed: int = 0
    """Of the searches."""
    despite_doubts: bool = False
    """Go on with a goal photo that is not explained well."""
    device: Device = "auto"

    def run(self) -> dict[str, Any]:
        """Drive; the result is report.json without the single steps."""
        from ..episodes.progress import EpisodeProgress
        from ..episodes.robot import RobotDrive

        order = self._order()
        with contextlib.ExitStack() as opened:

            def permit() -> bool:
                allowed = self.yes or _asked(drive, self.url)
                if allowed and opened.enter_context(stop_on_key(drive.stop)):
                    self.say("It moves. Any key stops it.")
                return allowed

            drive = opened.enter_context(contextlib.closing(RobotDrive(order, permit)))
            progress, said, doubts = EpisodeProgress(0, self.steps, ""), "", 0
            for event in drive.run():
                for doubt in drive.doubts[doubts:]:
                    self.say(doubt)
                doubts = len(drive.doubts)
                progress = progress.after(event)
                note = progress.note.partition(": ")[0]  # what follows counts up
                if note != said:
                    self.say(note)
                said = note
        report = drive.finish()
        self.say(f"{report['text']} {report['steps_done']} actions, {report['seconds']:.0f} s. Report: {self.out}")
        self.say_if_no_video()
        return {key: value for key, value in report.items() if key not in ("steps", "actions", "goal")}

    def _order(self) -> Any:  # noqa: ANN401  a DriveOrder, whose module is heavy
        from osfcore.contrib.robots.robot import SafetyLimits
        from osfcore.control.events import EpisodeSettings
        from osfcore.fields.devices import pick_device
        from osfcore.planning.mppi import PlanSettings

        from ..episodes.file_names import REPORT_FILE
        from ..episodes.robot import DriveOrder

        plan = PlanSettings(self.samples, self.horizon)
        settings = EpisodeSettings(self.steps, plan=plan, despite_doubts=self.despite_doubts)
        check_place(self.out / REPORT_FILE)
        boxes, speed = read_boxes(self.boxes), self.top_speed
        limits = SafetyLimits(top_speed_m_s=speed) if self.box is None else SafetyLimits(self.box, speed)
        return DriveOrder(
            self.url, self.names, self.goal, self.out, self.data_dir, self.goal_camera, self.goal_encoding,
            boxes, limits, check_seed(self.seed), settings, str(pick_device(self.device)),
        )  # fmt: skip


def _timed_look(robot: Robot) -> tuple[Observation, float]:
    begin = time.perf_counter()
    return robot.observe(), time.perf_counter() - begin


def read_boxes(texts: tuple[str, ...]) -> CameraBoxes:
    """Boxes as people write them.

    Raises:
        InvalidInput: if one is not of the form.
    """
    boxes: dict[str, dict[str, tuple[float, float, float, float]]] = {}
    for text in texts:
        camera, _, rest = text.partition(":")
        name, _, numbers = rest.partition(":")
        try:
            left, top, right, bottom = (float(number) for number in numbers.split(","))
        except ValueError:
            raise InvalidInput("box", text, _FORM) from None
        boxes.setdefault(camera, {})[name] = (left, top, right, bottom)
    return boxes


def _asked(drive: RobotDrive, url: str) -> bool:
    """Whether a person says yes; no where there is none."""
    x0, y0, x1, y1 = drive.limits.box
    print(
        f"It stays within x {x0:g} to {x1:g}, y {y0:g} to {y1:g} m, no faster than {drive.limits.top_speed_m_s:g} m/s."
    )
    try:
        return input(f"Move the robot at {url}? [y/N] ").strip().lower() in ("y", "yes")
    except EOFError:
        return False


def _write_pictures(overlay: Path, seen: Observation) -> None:
    """All cameras with the table's axes, and beside that what each sees as cameras encode it."""
    from osfcore.estimation.camera_response import srgb_of_linear
    from osfcore.inspection.overlays import observation_sheet
    from osfcore.io.image_file import to_uint8, write_png

    write_png(overlay, observation_sheet(seen)[..., ::-1])
    for camera, image in zip(seen.cameras, seen.images, strict=True):
        write_png(overlay.with_name(f"{shown(camera.name).replace('/', '_')}.png"), to_uint8(srgb_of_linear(image)))


@contextlib.contextmanager
def stop_on_key(stop: Callable[[str], None], terminal: int = 0) -> Iterator[bool]:
    """Call for a stop, once, at the first key that is pressed while the context is open.

    Args:
        stop: takes the reason; called from a thread of its own.
        terminal: file descriptor of it; standard input.

    Yields:
        Whether there is a terminal: where there is none, no key is waited for.
    """
    if not os.isatty(terminal):
        yield False
        return
    ended = threading.Event()
    listener = threading.Thread(target=_listen, args=(stop, terminal, ended), name="stop key", daemon=True)
    with _keys_at_once(terminal):
        listener.start()
        try:
            yield True
        finally:
            ended.set()
            listener.join()


@contextlib.contextmanager
def _keys_at_once(terminal: int) -> Iterator[None]:
    """Let keys come at once and unseen; Ctrl-C still interrupts."""
    if sys.platform == "win32":  # they do, for whoever reads them by msvcrt
        yield
        return
    import termios
    import tty

    before = termios.tcgetattr(terminal)
    try:
        tty.setcbreak(terminal)
        yield
    finally:
        termios.tcsetattr(terminal, termios.TCSADRAIN, before)


def _listen(stop: Callable[[str], None], terminal: int, ended: threading.Event) -> None:
    while not ended.is_set():
        if _was_pressed(terminal):
            stop("a key was pressed")
            return


def _was_pressed(terminal: int) -> bool:
    """Wait a moment for a key, and take it."""
    if sys.platform == "win32":
        import msvcrt

        time.sleep(_LISTENS_EVERY_S)
        if is_there := msvcrt.kbhit():
            msvcrt.getch()
        return is_there
    is_there = bool(select.select([terminal], [], [], _LISTENS_EVERY_S)[0])
    if is_there:
        with contextlib.suppress(OSError):  # a terminal that was closed is a reason, too
            os.read(terminal, 1)
    return is_there


RobotCommand = choice_of(check=RobotCheck, drive=RobotDriveCommand)
