"""`osf eval` and `osf reproduce`: the paper's experiments, measured on what nothing was trained on."""

from __future__ import annotations

import os
import platform
import shlex
import sys
from abc import abstractmethod
from collections.abc import Iterator, Mapping
from concurrent.futures import Executor
from contextlib import AbstractContextManager
from dataclasses import dataclass, replace
from datetime import date
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal

from osfcore.errors import InvalidInput
from osfcore.extras import need

from .command import DataCommand, Seed, choice_of, report_of, show_table
from .workers import worker_pool

if TYPE_CHECKING:
    from osfcore.experiments.reproduction.reproduction import Scale


@dataclass(frozen=True)
class Evaluation(DataCommand):
    """What all evaluations share. A killed one goes on when started again, and may be run in pieces."""

    out: Path | None = None
    """Folder for results and pictures; DATA_DIR/evaluation by default."""
    names: tuple[str, ...] | None = None
    """Objects; by default all that have a field and a mesh."""
    tasks: int = 20
    """Scenes against the simulator, each with its own objects and light."""
    seed: Seed = 0

    @property
    def folder(self) -> Path:
        """Where results are kept."""
        return self.out or self.data_dir / "evaluation"

    def run(self) -> dict[str, Any]:
        """Measure with a progress bar; the result holds what the evaluation's report does."""
        need("experiments", "This command")  # before hours of work
        with self._pool() as executor:
            report = report_of(self._steps(executor))
        report = report if isinstance(report, dict) else report.to_json()
        if not self.json:
            self._show(report)
        return report

    def _pool(self) -> AbstractContextManager[Executor | None]:
        return worker_pool(1)

    @abstractmethod
    def _steps(self, executor: Executor | None) -> Iterator[Any]:
        """The evaluation's steps, of which the last brings the report."""

    @abstractmethod
    def _show(self, report: dict[str, Any]) -> None:
        """Print the report for people."""


@dataclass(frozen=True)
class ParallelEvaluation(Evaluation):
    """One whose work is shared out."""

    workers: int = 2
    """Processes that work side by side."""
    cluster: str | None = None
    """Address of a Dask scheduler whose workers do the work instead, or slurm, or slurm:partition=gpu,time=60: a job
    of SLURM each. They need the same data folder."""

    def _pool(self) -> AbstractContextManager[Executor | None]:
        return worker_pool(self.workers, self.cluster)


@dataclass(frozen=True)
class EvaluateFieldsCommand(Evaluation):
    """Fields: each object alone on unseen views under unseen lights, and scenes of several."""

    objects: int = 3
    """Objects in a scene."""
    data: Path | None = None
    """With --weights: measure on the test images of this set in the OSF format instead of the simulator's."""
    weights: Path | None = None
    """With --data: the field to measure."""

    def _steps(self, executor: Executor | None) -> Iterator[Any]:
        from osfcore.experiments.fields import EvaluateFields, EvaluateSet, evaluate_fields, evaluate_set

        if self.data is not None and self.weights is not None:
            return evaluate_set(EvaluateSet(self.data, self.weights, self.folder))
        if self.data is not None or self.weights is not None:
            raise InvalidInput("choice of --data and --weights", "one alone", "both or none")
        config = EvaluateFields(self.folder, self.names, self.tasks, self.objects, self.seed)
        return evaluate_fields(config, self.trained, self.assets)

    def _show(self, report: dict[str, Any]) -> None:
        rows = []
        for name, row in report["objects"].items():
            minutes = "" if row["minutes"] is None else f"{row['minutes']:.1f}"
            figures = (f"{row['psnr_full']:.2f}", f"{row['psnr_mask']:.2f}", f"{row['ssim']:.4f}")
            rows.append((name, *figures, f"{row['file_mb']:.2f}", minutes))
        means = (f"{report['psnr_full_mean']:.2f}", f"{report['psnr_mask_mean']:.2f}", f"{report['ssim_mean']:.4f}")
        rows.append(("mean (size: most)", *means, f"{report['max_file_mb']:.2f}", ""))
        show_table(rows, ("object", "full dB", "mask dB", "SSIM", "MB", "minutes"), left=("object",))
        if report["scenes"]:
            keys = {"whole": "scene_psnr_mean", "objects": "scene_psnr_object_mean", "shadow": "scene_psnr_shadow_mean"}
            parts = [f"{what} {report[key]:.2f} dB" for what, key in keys.items() if report[key] is not None]
            print(f"{report['scenes']} scenes: {', '.join(parts)}")


@dataclass(frozen=True)
class EvaluateEstimateCommand(ParallelEvaluation):
    """Estimates of poses and light: first frames, along pushes without masks, goals, ablations, spoiled inputs."""

    objects: int = 3
    """Objects in a scene."""
    parts: tuple[Literal["first", "track", "goal", "ablations"], ...] = ("first", "track", "goal", "ablations")
    """What to measure; first frames are in any case."""
    bad: int = 0
    """Number of spoiled inputs (100 gives ten of each kind)."""
    factor: tuple[str, ...] = ()
    """Things in which pictures differ from what the method takes for granted, such as exposure_0.7, or "all" of them:
    first frames are measured under each."""

    def _steps(self, executor: Executor | None) -> Iterator[Any]:
        from osfcore.experiments.estimation import EvaluateEstimate, evaluate_estimate
        from osfcore.experiments.factors import FIRST_FRAME_FACTORS

        factors = FIRST_FRAME_FACTORS if self.factor == ("all",) else self.factor
        config = EvaluateEstimate(
            self.folder, self.tasks, self.objects, self.seed, self.parts, self.bad, self.names, factors=factors
        )
        return evaluate_estimate(config, self.trained, self.assets, executor)

    def _show(self, report: dict[str, Any]) -> None:
        print(
            f"First frames: {report['tasks']} scenes, {report['objects_total']} objects: "
            f"{_percent(report['frac_1cm_5deg'])} under 1 cm and 5 deg; medians {_errors(report)}, "
            f"ADD-S {_number(report['adds_mm_median'])} mm, {_number(report['first_s_median'])} s."
        )
        print(
            f"Claimed deviations: {_percent(report['two_sigma_coverage'])} of errors within two; "
            f"{_number(report['mean_position_std_mm'], 2)} mm on average. "
            f"Flagged: {_percent(report['flagged_good'])} of right estimates, "
            f"{_percent(report['flagged_bad'])} of wrong ones."
        )
        if report["track_episodes"] is not None:
            drift = ", ".join(f"{_number(mm)} mm after {step}" for step, mm in report["drift_mm"].items())
            print(
                f"Tracks: {report['track_lost']} of {report['track_episodes']} lost "
                f"({report['track_lost_from_wrong_start']} from a wrong first frame), {drift} steps; "
                f"{_number(report['refine_hz'])} Hz."
            )
        if report["goal_objects_total"] is not None:
            goals = {key.removeprefix("goal_"): value for key, value in report.items() if key.startswith("goal_")}
            print(
                f"Goals: {_percent(goals['frac_1cm_5deg'])} of {goals['objects_total']} objects under 1 cm and 5 deg; "
                f"medians {_errors(goals)}, {_number(goals['s_median'])} s."
            )
        if report["by_views"] is not None:
            rows = {f"{n} views" if n != "1" else "1 view": row for n, row in report["by_views"].items()}
            for what, row in {"light held overhead": report["fixed_light"], **rows}.items():
                print(f"  {what}: {_percent(row['frac_1cm_5deg'])} under 1 cm and 5 deg; medians {_errors(row)}")
        for name, row in report.get("by_factor", {}).items():
            print(
                f"  {name}: {_percent(row['frac_1cm_5deg'])} of {row['objects_total']} objects; "
                f"medians {_errors(row)}, {_percent(row['light_frac_10deg'])} of lights within 10 deg; "
                f"{row['wrong_unflagged']} wrong without a warning; {_number(row['first_s_median'])} s"
            )
        if "bad_cases" in report:
            print(
                f"Bad cases: {report['bad_cases']}: {report['bad_refused']} refused, {report['bad_flagged']} flagged, "
                f"{report['bad_right']} right, {report['bad_confident_wrong']} wrong without a warning."
            )
        print(f"Pictures and figures: {self.folder}")


@dataclass(frozen=True)
class EvaluatePublishedCommand(ParallelEvaluation):
    """First frames by the estimation as published, under the choices that the paper's text leaves open."""

    objects: int = 3
    """Objects in a scene."""
    fields: Literal["paper", "ours"] = "paper"
    """Whose appearance is compared with the images; ours are drawn faster."""
    settings: tuple[str, ...] = ()
    """Some of the settings, such as '24 starts'; all by default."""
    families: tuple[Literal["any", "upright"], ...] = ("any", "upright")
    """How objects lie: in any resting orientation, or all of them upright."""

    def _steps(self, executor: Executor | None) -> Iterator[Any]:
        from osfcore.experiments.paper_estimation import SETTINGS, EvaluatePaperEstimation, evaluate_paper_estimation

        config = EvaluatePaperEstimation(
            self.folder / "published", self.data_dir, self.names, self.tasks, self.seed, self.objects,
            self.settings or tuple(SETTINGS), self.families, self.fields,
        )  # fmt: skip
        return evaluate_paper_estimation(config, self.trained, self.assets, executor)

    def _show(self, report: dict[str, Any]) -> None:
        for family, rows in report["families"].items():
            print(f"Objects {'upright' if family == 'upright' else 'in any resting orientation'}:")
            shown = [
                (name, _percent(row["share"]), _number(row["mm_median"]), _number(row["deg_median"]),
                 _number(row["light_deg_median"]), _percent(row["eq5_prefers_wrong"]), _number(row["seconds_median"]))
                for name, row in rows.items()
            ]  # fmt: skip
            titles = ("setting", "1 cm, 10 deg", "mm", "deg", "light deg", "eq. 5 prefers wrong", "s")
            show_table(shown, titles, left=("setting",))
        print(f"Figures: {self.folder / 'published'}")


@dataclass(frozen=True)
class EvaluateDynamicsCommand(ParallelEvaluation):
    """Predicted pushes of two to six objects against the simulator, a quasi-static model and the constant pose.

    Objects and pairs of objects that training never saw are among them.
    """

    method: Literal["ours", "paper"] = "ours"
    """Whose predictions: our model's; the paper's as published, with results in the folder paper within --out."""
    simulator: Literal["pybullet", "mujoco"] | None = None
    """What moves the objects; PyBullet where it is installed, else MuJoCo."""

    def _steps(self, executor: Executor | None) -> Iterator[Any]:
        from osfcore.experiments.dynamics import EvaluateDynamics, evaluate_dynamics
        from osfcore.world.simulators import default_simulator

        simulator = self.simulator or default_simulator()
        config = EvaluateDynamics(self.folder, self.tasks, self.seed, self.names, self.data_dir, self.method, simulator)
        return evaluate_dynamics(config, self.trained, self.assets, executor)

    def _show(self, report: dict[str, Any]) -> None:
        folder = self.folder if self.method == "ours" else self.folder / self.method
        print(f"Three objects, {report['windows']} that moved within 4 steps of 0.2 s:")
        for horizon in (1, 4, 10, 30):
            mm, deg = report[f"median_mm_{horizon}"], report[f"median_deg_{horizon}"]
            others = [_number(report[f"{who}_mm_{horizon}"]) for who in ("constant", "analytic")]
            parts = f"constant pose {others[0]}, quasi-static {others[1]} mm"
            print(f"  after {horizon}: median {_number(mm)} mm, {_number(deg)} deg ({parts})")
        print(f"  what does not move drifts by {_number(report['still_drift_mm_30'], 2)} mm in 30 steps")
        for count, row in report["by_objects"].items():
            mm, deg = _number(row["median_mm_4"]), _number(row["median_deg_4"])
            print(f"{count} objects: {mm} mm, {deg} deg after 4 steps")
        if report["unseen_objects"]:
            unseen, seen = (_number(report[f"{which}_objects_mm_4"]) for which in ("unseen", "seen"))
            names = ", ".join(report["unseen_objects"])
            print(f"Objects never seen ({names}): {unseen} mm; having seen them {seen} mm")
        print(f"{report['rollout_steps_per_s']} steps of scenes a second. Pictures and figures: {folder}")


@dataclass(frozen=True)
class EvaluateMpcCommand(ParallelEvaluation):
    """Episodes: tables that shall become what a goal image shows; the same planner given the truth; no action."""

    family: Literal["shifted", "turned", "crowded", "relit", "upright"] = "shifted"
    """What goals ask for: objects elsewhere; turned as well; in one another's places; photographed in another light;
    elsewhere, all of them upright."""
    objects: int = 3
    """Objects in a scene, 1 to 6."""
    actions: int = 30
    """Actions of 0.2 s that an episode may have; 30 in the paper."""
    method: Literal["ours", "overhead", "known_light", "nerf", "paper", "foresight"] = "ours"
    """Whose episodes: ours; with the light taken to be overhead; given the true light; with fields that know of no
    light; the paper's, as published; visual foresight on predicted video."""
    ours: tuple[Literal["fields", "estimation", "dynamics", "planning"], ...] = ()
    """With --method paper: stages that are replaced by ours."""
    truths: tuple[Literal["poses", "goal", "dynamics"], ...] = ()
    """With --method ours: stages that are replaced by the truth."""
    views: int = 4
    """Cameras that look, 1 to 4."""
    masks: bool = False
    """With --method paper: masks at every step, not in the first frame alone."""
    samples: int | None = None
    """Sequences of actions in each round of a plan (K): 160 by default, 200 as published, 16 of foresight."""
    horizon: int | None = None
    """Actions in each (T): 30 by default, 15 as published, 10 of foresight."""
    factor: str = ""
    """One thing in which the world differs from what the method takes for granted, such as table_wood."""
    cost: Literal["pose", "image"] = "pose"
    """Futures are compared with the goal's poses, or rendered and compared with the goal image."""
    oracle: bool = True
    """Also measure the planner that is given the truth."""
    oracle_samples: int = 192
    """Sequences of actions in each round of its plans."""
    oracle_tries: int = 8
    """Episodes that it has at most for each task, of which the best counts; the last with the simulator's pushes."""
    simulator: Literal["pybullet", "mujoco"] | None = None
    """What moves the objects; PyBullet where it is installed, else MuJoCo."""

    def _steps(self, executor: Executor | None) -> Iterator[Any]:
        from osfcore.control.events import EpisodeSettings
        from osfcore.experiments.rearrangement import ORACLE_PLAN, EvaluateMpc, evaluate_mpc
        from osfcore.experiments.rearrangement_runs import Variant
        from osfcore.experiments.rivals.visual_foresight import ForesightSettings
        from osfcore.paper.mppi import GaussianPlanSettings
        from osfcore.planning.mppi import PlanSettings
        from osfcore.world.simulators import default_simulator

        variant = Variant(self.method, frozenset(self.ours), frozenset(self.truths), self.views, self.masks)
        asked = {"samples": self.samples, "horizon": self.horizon}
        plan = {key: value for key, value in asked.items() if value is not None}
        config = EvaluateMpc(
            self.folder, self.data_dir, self.tasks, self.objects, self.seed, self.family, self.actions, variant,
            self.factor, self.cost, self.names, self.oracle, self.oracle_tries,
            EpisodeSettings(plan=PlanSettings(**plan)), replace(ORACLE_PLAN, samples=self.oracle_samples),
            GaussianPlanSettings(**plan), ForesightSettings(**plan), self.simulator or default_simulator(),
        )  # fmt: skip
        return evaluate_mpc(config, self.trained, self.assets, executor)

    def _show(self, report: dict[str, Any]) -> None:
        print(
            f"{report['tasks']} tasks of the family {report['family']!r} with {report['objects']} objects and "
            f"{report['actions']} actions, {report['cost']} cost:"
        )
        low, high = report["success_tight_interval"]
        print(
            f"{_percent(report['success_tight'])} within 2 cm and 0.1 rad ({100 * low:.0f} to {_percent(high)}), "
            f"{_percent(report['success_2cm'])} within 2 cm; {report['refused']} goals refused."
        )
        overruled = [_percent(report[f"success_{which}_overruled"]) for which in ("tight", "2cm")]
        print(f"With doubts about goals overruled: {overruled[0]} and {overruled[1]}.")
        moved = ", ".join(f"{_percent(share)} of {count}" for count, share in report["success_by_moved"].items())
        print(f"By number of objects that had to move: {moved}.")
        ends = f"{_number(report['final_mm_mean'])} mm (median {_number(report['final_mm_median'])} mm)"
        print(f"These end {ends} from their goals, from {_number(report['start_mm_mean'])} mm.")
        if report["oracle_success_2cm"] is not None:
            print(
                f"Told the truth, the same planner at its best: {_percent(report['oracle_success_tight'])} and "
                f"{_percent(report['oracle_success_2cm'])}, {_number(report['oracle_final_mm_mean'])} mm."
            )
        distances = [_number(report[f"{who}pose6d_symmetric_mean"], 3) for who in ("", "noaction_")]
        print(f"6D pose distance, symmetries considered: {distances[0]} on average, {distances[1]} without any action.")
        plan, look, whole = (report[f"{stage}_s_median"] for stage in ("replan", "estimate", "episode"))
        print(f"A plan takes {_number(plan)} s, an estimate {_number(look, 2)} s, an episode {_number(whole, 0)} s.")
        print(f"Pictures and figures: {self.folder}")


@dataclass(frozen=True)
class EvaluateRelightingCommand(ParallelEvaluation):
    """Scenes under lights of many elevations, true poses and light given, as each method shows them."""

    methods: tuple[Literal["ours", "paper", "nerf", "nerf_fitted"], ...] = ("ours", "paper", "nerf", "nerf_fitted")
    """Our fields; KiloOSFs as published; compositional NeRFs, which know of no light; these with each object and the
    table as bright as fits the true images best."""
    objects: int = 3
    """Objects in a scene."""
    elevations: tuple[float, ...] = (5, 10, 20, 30, 45, 60, 75, 90)
    """Of the lights above the table [deg]."""
    factor: str = ""
    """One thing in which the world differs from what fields learned, such as objects_shiny or renderer_tiny."""
    sky: bool = False
    """Show scenes also as they are on average under lights from all over the sky, which is what NeRFs learn."""

    def _steps(self, executor: Executor | None) -> Iterator[Any]:
        from osfcore.experiments.relighting import CompareRelighting, compare_relighting

        config = CompareRelighting(
            self.folder, self.data_dir, self.names, self.tasks, self.seed, self.methods, self.objects, self.elevations,
            self.factor, self.sky,
        )  # fmt: skip
        return compare_relighting(config, self.trained, self.assets, executor)

    def _show(self, report: dict[str, Any]) -> None:
        measures = {"psnr": "PSNR", "ssim": "SSIM", "psnr_object": "objects dB", "psnr_shadow": "shadows dB"}
        _show_methods(report, {title: (key, "all") for key, title in measures.items()})
        print(f"{report['tasks']} scenes. Pictures and figures: {self.folder}")


@dataclass(frozen=True)
class EvaluateVideoCommand(ParallelEvaluation):
    """Pushes predicted as images of the goal camera, against the simulator, method by method."""

    methods: tuple[Literal["copied", "ours", "paper", "nerf", "fitvid"], ...] = (
        "copied", "ours", "paper", "nerf", "fitvid",
    )  # fmt: skip
    """The last frame, copied; ours; the method as published; ours with compositional NeRFs; FitVid."""
    objects: int = 3
    """Objects in a scene."""
    steps: int = 30
    """Actions of 0.2 s that are predicted."""

    def _steps(self, executor: Executor | None) -> Iterator[Any]:
        from osfcore.experiments.video_prediction import CompareVideos, compare_videos

        config = CompareVideos(
            self.folder, self.data_dir, self.names, self.tasks, self.seed, self.methods, self.objects, self.steps
        )  # fmt: skip
        return compare_videos(config, self.trained, self.assets, executor)

    def _show(self, report: dict[str, Any]) -> None:
        spans = next(iter(report["methods"].values()))["psnr"]["spans"]
        titles = {"psnr": "PSNR", "ssim": "SSIM", "mse": "MSE"}
        columns = {f"{title} {span}": (key, span) for key, title in titles.items() for span in spans}
        _show_methods(report, columns)
        print(f"Means over so many steps of {report['tasks']} episodes. Pictures and figures: {self.folder}")


@dataclass(frozen=True)
class EvaluatePhotosCommand(DataCommand):
    """Photographs: objects by boxes or masks, without a start or from poses of another program; lamps."""

    data: Path | None = None
    """Folder of folders with photo.json, or of chrome balls under lamps."""
    lamps: Literal["photographed", "simulated"] = "photographed"
    """simulated: near lamps over simulated tables instead, without data."""
    drawn: int = 0
    """Photographs to draw of simulated tables, cluttered and as phones store them, and to measure instead of --data."""
    tasks: int = 20
    """Simulated scenes with a near lamp; a fourth as many have a distant one."""
    views: int = 1
    """Photographs of each drawn table, 1 to 8, which are looked at together; of each simulated scene, 1 to 4."""
    start: str = "none"
    """none; perturbed (3 cm and 20 deg off the truth); or a source of poses in photo.json, such as posecnn_raw."""
    plane: Literal["known", "free"] = "free"
    """Whether the table's plane is known, as it was drawn or from the measured depth."""
    masks: Literal["given", "boxes"] = "given"
    """The folder's, or what a box around each of them and one click give, as a user has it."""
    mask_error: int = 0
    """Masks are grown and shrunk by that many pixels in turn."""
    repeats: int = 1
    """Random starts of each object."""
    loss: Literal["all", "iou"] = "all"
    """Colours, print and outline; the outline alone, as in the paper."""
    out: Path | None = None
    """Folder for report.json and contact sheets; DATA_DIR/photos by default."""
    seed: Seed = 0

    def run(self) -> dict[str, Any]:
        """Measure with a progress bar; the result holds what report.json does."""
        from osfcore.experiments.drawn_photos import write_drawn_photos
        from osfcore.experiments.lamps import EvaluateLamps, evaluate_lamps
        from osfcore.experiments.photos import EvaluatePhotos, evaluate_photos

        if self.lamps == "simulated":
            folder = self.out or self.data_dir / "lamps"
            config = EvaluateLamps(folder, self.tasks, self.views, self.seed)
            report = report_of(evaluate_lamps(config, self.assets, self.trained))
            self.say(*_lamps_of(report), f"Figures: {folder}")
            return report
        folder, data = self.out or self.data_dir / "photos", self.data
        if self.drawn:
            data = folder / "drawn"
            write_drawn_photos(self.assets, data, self.seed, self.drawn, self.views)
        if data is None:
            allowed = "a folder of photographs, or --drawn or --lamps simulated, which need none"
            raise InvalidInput("data", "missing", allowed)
        config = EvaluatePhotos(folder, data, self.start, self.plane, self.mask_error, self.repeats, self.loss,
                                self.seed, self.masks)  # fmt: skip
        report = report_of(evaluate_photos(config, self.trained))
        self.say(*_photos_of(report), f"Pictures and figures: {folder}")
        return report


@dataclass(frozen=True)
class ReproduceCommand(DataCommand):
    """The paper's figures, its rivals, and what else there is to know, as one HTML page.

    A killed run goes on when started again. Without --quick it takes days on two cores.
    """

    out: Path
    """Folder for report.html, the same as report.md, the figures as JSON, and the results of all tasks."""
    quick: bool = False
    """A look in a quarter of an hour on two cores: three tasks a cell, short episodes, fewer cells."""
    only: tuple[
        Literal[
            "estimation", "relighting", "dynamics", "video", "photos",
            "methods", "families", "ablations", "ladder", "factors", "attribution",
        ],
        ...,
    ] = ()  # fmt: skip
    """Parts of the report; all by default."""
    tasks: int | None = None
    """Tasks of each cell; 3 with --quick, else 100 of the methods with three objects and 50 of all others."""
    objects: int | None = None
    """In a scene; 1 with --quick, else 2, 3 and 4 for the methods and 3 for everything else."""
    actions: int | None = None
    """That an episode may have; 12 with --quick, else 30."""
    seed: Seed = 0
    names: tuple[str, ...] | None = None
    """Objects; by default all of which every method has a field."""
    photos: Path | None = None
    """Folder of photographs as 'osf eval photos' takes them; without one the part on photographs is left out."""
    finished: bool = False
    """Run no more episodes: report those that are finished, those of 'osf eval mpc' in the same folder among them."""
    workers: int = 2
    """Processes that work side by side."""
    cluster: str | None = None
    """Address of a Dask scheduler whose workers do the work instead, or slurm, or slurm:partition=gpu,time=60: a job
    of SLURM each. They need the same data folder."""

    def run(self) -> dict[str, Any]:
        """Measure with a progress bar; the result holds all figures of the report."""
        from osfcore.experiments.reproduction import reproduction as paper

        need("experiments", "This command")  # before hours of work
        scale = self._changed(paper.QUICK if self.quick else paper.Scale())
        system = f"{platform.machine()}, {platform.system()}, Python {platform.python_version()}"
        called = shlex.join(["osf", *sys.argv[1:]])
        about = paper.About(date.today().isoformat(), f"{os.cpu_count()} cores, {system}", called, self.seed, ())
        config = paper.Reproduce(
            self.out, self.data_dir, about, scale, self.quick, self.only or paper.PARTS, self.names, self.photos,
            self.finished,
        )  # fmt: skip
        with worker_pool(self.workers, self.cluster) as executor:
            report = report_of(paper.reproduce(config, self.trained, self.assets, executor))
        self.say(*report["findings"], f"The report: {self.out / paper.PAGE_FILE}")
        return report

    def _changed(self, scale: Scale) -> Scale:
        """A scale with what was asked for."""
        if self.tasks is not None:
            scale = replace(scale, tasks=self.tasks, headline=self.tasks)
        if self.objects is not None:
            scale = replace(scale, objects=self.objects, counts=(self.objects,))
        if self.actions is not None:
            scale = replace(scale, settings=replace(scale.settings, steps=self.actions))
        return scale


Evaluate = choice_of(
    fields=EvaluateFieldsCommand,
    estimate=EvaluateEstimateCommand,
    published=EvaluatePublishedCommand,
    dynamics=EvaluateDynamicsCommand,
    mpc=EvaluateMpcCommand,
    relighting=EvaluateRelightingCommand,
    video=EvaluateVideoCommand,
    photos=EvaluatePhotosCommand,
)


def _show_methods(report: dict[str, Any], columns: Mapping[str, tuple[str, str]]) -> None:
    """A row for each method with its means, then one for how much ours differs from each other one.

    Args:
        report: of a comparison.
        columns: measure and span, by title.
    """

    def row(title: str, figures: Iterator[float | None]) -> list[str]:
        return [title, *("-" if value is None else f"{value:.4g}" for value in figures)]

    rows = [
        row(method, (figures[key]["spans"][span]["mean"] for key, span in columns.values()))
        for method, figures in report["methods"].items()
    ]
    rows += [
        row(f"ours - {method}", (figures[key][span]["difference"] for key, span in columns.values()))
        for method, figures in report["against"].items()
    ]
    show_table(rows, ("method", *columns), left=("method",))


def _photos_of(report: dict[str, Any]) -> Iterator[str]:
    """The report of photographs for people."""
    for score in report["scores"]:
        turned = "" if score["rotation_deg"] is None else f", {score['rotation_deg']:.1f} deg"
        depth = "" if score["depth_mm"] is None else f", depth {score['depth_mm']:+.0f} mm"
        yield f"{score['scene']} {score['name']}: IoU {score['iou']:.3f}{turned}{depth}  {score['doubt']}".rstrip()
    if report["objects_total"]:
        yield (
            f"{report['objects_total']} objects: IoU median {report['iou_median']:.3f}, least {report['iou_min']:.3f}; "
            f"{report['coarse_s_median']:.1f} + {report['refine_s_median']:.1f} s each. "
            f"Masks agree with the given ones by {report['mask_iou_median']:.3f} in the median, "
            f"{report['mask_iou_min']:.3f} at least."
        )
    if report["light_deg_median"] is not None:
        yield f"Lamps: median error {report['light_deg_median']:.1f} deg, most {report['light_deg_max']:.1f} deg."


def _lamps_of(report: dict[str, Any]) -> Iterator[str]:
    """The report of simulated lamps for people."""
    for score in report["scores"]:
        true = "a distant lamp" if score["true_m"] is None else f"a lamp {score['true_m']:.2f} m away"
        found = "unknown" if score["distance_m"] is None else f"{score['distance_m']:.2f} m"
        yield f"Scene {score['number']}, {true}: direction {score['direction_deg']:.1f} deg off, distance {found}."
    yield (
        f"{report['lamp_tasks']} near lamps: direction {report['lamp_direction_deg_median']:.1f} deg off (median), "
        f"{100 * report['lamp_within_5deg']:.0f} % within 5 deg; distance unknown of {report['lamp_undetermined']}."
    )
    if report["lamp_distance_percent_median"] is not None:
        yield f"Distances known: {report['lamp_distance_percent_median']:.1f} % off (median)."


def _errors(row: dict[str, Any]) -> str:
    return (
        f"{_number(row['position_mm_median'])} mm, {_number(row['rotation_deg_median'])} deg, "
        f"light {_number(row['light_deg_median'])} deg"
    )


def _number(value: float | None, digits: int = 1) -> str:
    return "-" if value is None else f"{value:.{digits}f}"


def _percent(share: float | None) -> str:
    return "-" if share is None else f"{100 * share:.1f} %"
