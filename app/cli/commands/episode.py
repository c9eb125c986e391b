"""`osf episode`: Algorithm 1 in the simulator, without a browser."""

from __future__ import annotations

from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Literal

from app.cli.progress_bar import follow
from app.storage.paths import default_data_dir


@dataclass(frozen=True)
class RunEpisode:
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
    device: Literal["auto", "cpu", "cuda"] = "auto"
    """What computes; auto takes a GPU where there is one."""
    data_dir: Path = field(default_factory=default_data_dir)
    """Where fetched objects, and fields and networks trained on this machine, are."""
    json: bool = False
    """Print the report, but for its single steps, as one JSON object in the last line."""

    def run(self) -> dict[str, Any]:
        """Run it with a progress bar; the result is report.json without the single steps."""
        from app.episodes.file_names import REPORT_FILE
        from app.episodes.headless import run_episode
        from app.episodes.request import EpisodeOrder, PartNames
        from osfcore.control.events import CostKind, EpisodeSettings
        from osfcore.errors import check_seed
        from osfcore.fields.devices import pick_device
        from osfcore.io.output_paths import check_place
        from osfcore.planning.mppi import PlanSettings

        plan = PlanSettings(self.samples, self.horizon, self.temperature)
        cost: CostKind = "image" if self.cost == "image" else "pose"
        settings = EpisodeSettings(self.steps, self.replan_every, cost, plan, despite_doubts=self.despite_doubts)
        check_place(self.out / REPORT_FILE)
        order = EpisodeOrder(
            self.out, self.data_dir, self.names, self.objects, check_seed(self.seed), self.goal, self.found, self.moved,
            settings=settings, device=str(pick_device(self.device)),
            parts=PartNames(self.world, self.estimator, self.planner, self.cost),
        )  # fmt: skip
        last = follow(run_episode(order))
        assert last is not None
        assert last.report is not None, "the last step brings the report"
        if not self.json:
            _show(self.out, last.report)
        return {key: value for key, value in last.report.items() if key not in ("steps", "actions", "goal")}


def _show(out: Path, report: dict[str, Any]) -> None:
    from app.episodes.clip.layout import length_text

    print(f"{report['text']} {report['steps_done']} actions, {report['seconds']:.0f} s.")
    for notice in report["noticed"]:
        print(f"  step {notice['step']}: {notice['text']}")
    if "score" in report:
        worst = max(report["score"]["objects"], key=lambda one: one["mm"])
        where = f"{length_text(worst['mm'] / 1000)} and {worst['deg']:.0f} deg from its goal"
        print(f"In truth, {', '.join(report['moved'])} had to move; {worst['name']} ended farthest off, {where}.")
    print(f"Report, frames, video and recording: {out}")
