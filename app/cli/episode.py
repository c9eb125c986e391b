"""`osf episode`, `clip`, `lerobot`, `mcap` and `record`: episodes in the simulator, and what is made of them."""

from __future__ import annotations

from collections.abc import Iterator
from concurrent.futures import ThreadPoolExecutor
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any, Literal

import tyro

from osfcore.errors import check_seed
from osfcore.io.output_paths import check_place
from osfcore.io.video_file import need_ffmpeg

from .command import DataCommand, Device, last_of, report_of


@dataclass(frozen=True)
class RunEpisode(DataCommand):
    """Push objects until the table looks like a goal image, and keep everything: report, table of steps, frames, video.

    The scene is random; without a goal image, so is the goal. Lengths in the report are in mm.
    """

    out: Path
    """Folder for report.json, steps.csv, goal.png, frames/, video.mp4 and episode.viser."""
    goal: Path | None = None
    """PNG of how the table should look, taken by the goal camera without the pusher; a random goal without it."""
    found: Path | None = None
    """What `osf photo estimate` has found, instead: the objects shall lie as in that photo, and begin elsewhere."""
    names: tuple[str, ...] | None = None
    """Objects; a random choice without them."""
    objects: int = 3
    """How many, where no names are given."""
    seed: int = 0
    """Of scene, light, random goal and searches."""
    moved: int | None = None
    """How many objects a random goal moves; from one to all of them without it."""
    steps: int = 100
    """Actions at most, of 0.2 s each, counted anew after each disturbance. The paper has 30."""
    replan_every: int = 1
    """Actions executed of each plan."""
    cost: str = "pose"
    """Futures are compared with the goal's poses (pose), rendered and compared with the goal image, as in the paper
    (image), or as another package does it."""
    world: str = "simulated"
    """What is pushed: our simulation, or another package's."""
    simulator: Literal["pybullet", "mujoco"] | None = None
    """What moves the objects of our simulation; PyBullet where it is installed, else MuJoCo. The report says which."""
    planner: str = "mppi"
    """What plans: MPPI, or another package's."""
    estimator: str = "ours"
    """What looks: ours, or another package's."""
    samples: int = 160
    """Sequences of actions in each of a plan's two rounds."""
    horizon: int = 30
    """Actions in each."""
    temperature: float = 0.03
    """Of the softmax, as a share of the spread of costs."""
    despite_doubts: bool = False
    """Go on with a goal image that is not explained well, or with objects of a photo that are doubtful."""
    device: Device = "auto"

    def run(self) -> dict[str, Any]:
        """Run it with a progress bar; the result is report.json without the single steps."""
        from osfcore.control.events import CostKind, EpisodeSettings
        from osfcore.fields.devices import pick_device
        from osfcore.planning.mppi import PlanSettings

        from ..episodes.file_names import REPORT_FILE
        from ..episodes.record import PartNames
        from ..episodes.request import EpisodeOrder, run_episode

        plan = PlanSettings(self.samples, self.horizon, self.temperature)
        cost: CostKind = "image" if self.cost == "image" else "pose"
        settings = EpisodeSettings(self.steps, self.replan_every, cost, plan, despite_doubts=self.despite_doubts)
        check_place(self.out / REPORT_FILE)
        order = EpisodeOrder(
            self.out, self.data_dir, self.names, self.objects, check_seed(self.seed), self.goal, self.found, self.moved,
            settings=settings, device=str(pick_device(self.device)),
            parts=PartNames(self.world, self.estimator, self.planner, self.cost), simulator=self.simulator,
        )  # fmt: skip
        report = report_of(run_episode(order))
        self.say(*_summary(report), f"Report, frames, video and recording: {self.out}")
        self.say_if_no_video()
        return {key: value for key, value in report.items() if key not in ("steps", "actions", "goal")}


def _summary(report: dict[str, Any]) -> Iterator[str]:
    """What came of an episode, for people."""
    from ..episodes.clip import length_text

    yield f"{report['text']} {report['steps_done']} actions, {report['seconds']:.0f} s."
    for notice in report["noticed"]:
        yield f"  step {notice['step']}: {notice['text']}"
    if "score" in report:
        worst = max(report["score"]["objects"], key=lambda one: one["mm"])
        where = f"{length_text(worst['mm'] / 1000)} and {worst['deg']:.0f} deg from its goal"
        yield f"In truth, {', '.join(report['moved'])} had to move; {worst['name']} ended farthest off, {where}."


@dataclass(frozen=True)
class Clip(DataCommand):
    """Draw an episode in 1080p: 3D view, goal, table, distance, and what it came to; half a minute of work."""

    episode: tyro.conf.Positional[Path]
    """Folder that `osf episode` has left."""
    out: Path
    """The MP4."""

    def run(self) -> dict[str, Any]:
        """Make it."""
        from ..episodes.clip import FPS, clip_of

        need_ffmpeg("A clip")  # before the work
        with ThreadPoolExecutor(2) as executor:
            last = last_of(clip_of(self.episode, self.assets, self.out, executor))
        seconds = round(last.total / FPS, 1)
        self.say(f"{self.out}: {seconds:g} s")
        return {"out": str(self.out), "seconds": seconds}


@dataclass(frozen=True)
class LeRobot(DataCommand):
    """Write episodes as one LeRobot data set (format v3.0): actions, and what was known before each of them.

    Needs pyarrow, but not LeRobot: pip install 'osf-manipulation[lerobot]'.
    """

    episodes: tyro.conf.Positional[tuple[Path, ...]]
    """Folders that `osf episode` has left."""
    out: Path
    """Folder for the data set, new or empty."""
    obs: Literal["poses", "pixels", "both"] = "both"
    """What is observed besides the pusher: poses of objects and goals, images of cameras and goal, or both."""
    image_side: int = 128
    """Of images [px], even."""

    def run(self) -> dict[str, Any]:
        """Write it."""
        from ..episodes.lerobot import write_lerobot

        size = write_lerobot(self.episodes, self.assets, self.out, obs=self.obs, image_side=self.image_side)
        self.say(f"{self.out}: {size.episodes} episodes, {size.frames} frames, {size.tasks} tasks")
        return {"out": str(self.out), **asdict(size)}


@dataclass(frozen=True)
class Mcap(DataCommand):
    """Write an episode as one MCAP file: true, estimated and wanted poses, plans, images and notes over simulated time.

    Foxglove and Lichtblick play it. Needs foxglove-sdk: pip install 'osf-manipulation[mcap]'.
    """

    episode: tyro.conf.Positional[Path]
    """Folder that `osf episode` has left."""
    out: Path
    """The MCAP file; one of that name is replaced."""

    def run(self) -> dict[str, Any]:
        """Write it."""
        from ..episodes.mcap import write_mcap

        check_place(self.out)
        seconds = write_mcap(self.episode, self.assets, self.out)
        size = self.out.stat().st_size
        self.say(f"{self.out}: {seconds:g} s, {size / 1e6:.1f} MB")
        return {"out": str(self.out), "seconds": round(seconds, 3), "bytes": size}


@dataclass(frozen=True)
class Record(DataCommand):
    """Run the examples as episodes and keep what the page plays of them: small files, one folder for each.

    The stories that come with the program were made like this, with `--out static/stories`.
    """

    out: Path
    """Folder for the stories."""
    names: tuple[str, ...] | None = None
    """Examples, as the page and /api/presets call them; all without it."""

    def run(self) -> dict[str, Any]:
        """Make them one after the other; return how each episode ended."""
        from ..services.examples import PRESETS, preset
        from ..services.story_recording import record_story

        outcomes = {}
        for name in self.names or [one.id for one in PRESETS]:
            report = report_of(record_story(preset(name), self.data_dir, self.out / name))
            outcomes[name] = report["text"]
            self.say(f"{name}: {report['text']} {report['steps_done']} pushes.")
        return {"out": str(self.out), "stories": outcomes}
