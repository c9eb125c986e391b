"""`osf eval`: the paper's experiments, measured on what nothing was trained on."""

from __future__ import annotations

from collections.abc import Iterator
from concurrent.futures import Executor
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Literal

import tyro

from app.cli.commands.evaluations.evaluation import Evaluation, ParallelEvaluation
from app.cli.commands.evaluations.images import EvaluateRelightingCommand, EvaluateVideoCommand
from app.cli.commands.evaluations.photos import EvaluatePhotosCommand
from osfcore.errors import InvalidInput

if TYPE_CHECKING:
    from osfcore.fields.field_library import FieldLibrary
    from osfcore.objects.asset_library import AssetLibrary


@dataclass(frozen=True)
class EvaluateFieldsCommand(Evaluation):
    """Fields: each object alone on unseen views under unseen lights, and scenes of several."""

    objects: int = 3
    """Objects in a scene."""
    data: Path | None = None
    """With --weights: measure on the test images of this set in the OSF format instead of the simulator's."""
    weights: Path | None = None
    """With --data: the field to measure."""

    def _steps(self, fields: FieldLibrary, assets: AssetLibrary, executor: Executor | None) -> Iterator[Any]:
        from osfcore.experiments.fields import EvaluateFields, EvaluateSet, evaluate_fields, evaluate_set

        if self.data is not None and self.weights is not None:
            return evaluate_set(EvaluateSet(self.data, self.weights, self.folder))
        if self.data is not None or self.weights is not None:
            raise InvalidInput("choice of --data and --weights", "one alone", "both or none")
        config = EvaluateFields(self.folder, self.names, self.tasks, self.objects, self.seed)
        return evaluate_fields(config, fields, assets)

    def _show(self, report: dict[str, Any]) -> None:
        _show_fields(report)


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

    def _steps(self, fields: FieldLibrary, assets: AssetLibrary, executor: Executor | None) -> Iterator[Any]:
        from osfcore.experiments.estimation import EvaluateEstimate, evaluate_estimate
        from osfcore.experiments.factors import FIRST_FRAME_FACTORS

        factors = FIRST_FRAME_FACTORS if self.factor == ("all",) else self.factor
        config = EvaluateEstimate(
            self.folder, self.tasks, self.objects, self.seed, self.parts, self.bad, self.names, factors=factors
        )
        return evaluate_estimate(config, fields, assets, executor)

    def _show(self, report: dict[str, Any]) -> None:
        _show_estimate(self.folder, report)


@dataclass(frozen=True)
class EvaluateDynamicsCommand(ParallelEvaluation):
    """Predicted pushes of two to six objects against the simulator, a quasi-static model and the constant pose.

    Objects and pairs of objects that training never saw are among them.
    """

    method: Literal["ours", "paper"] = "ours"
    """Whose predictions: our model's; the paper's as published, with results in the folder paper within --out."""

    def _steps(self, fields: FieldLibrary, assets: AssetLibrary, executor: Executor | None) -> Iterator[Any]:
        from osfcore.experiments.dynamics import EvaluateDynamics, evaluate_dynamics

        config = EvaluateDynamics(self.folder, self.tasks, self.seed, self.names, self.data_dir, self.method)
        return evaluate_dynamics(config, fields, assets, executor)

    def _show(self, report: dict[str, Any]) -> None:
        _show_dynamics(self.folder if self.method == "ours" else self.folder / self.method, report)


@dataclass(frozen=True)
class EvaluateMpcCommand(ParallelEvaluation):
    """Episodes: tables that shall become what a goal image shows; the same planner told the truth; no action."""

    family: Literal["shifted", "turned", "crowded", "relit"] = "shifted"
    """What goals ask for: objects elsewhere; turned as well; in one another's places; photographed in another light."""
    objects: int = 3
    """Objects in a scene, 1 to 6."""
    actions: int = 30
    """Actions of 0.2 s that an episode may have; 30 in the paper."""
    method: Literal["ours", "overhead", "known_light", "nerf", "paper", "foresight"] = "ours"
    """Whose episodes: ours; with the light taken to be overhead; told the true light; with fields that know of no
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
    """Also measure the planner that is told the truth."""
    oracle_samples: int = 192
    """Sequences of actions in each round of its plans."""
    oracle_tries: int = 8
    """Episodes that it has at most for each task, of which the best counts; the last with the simulator's pushes."""

    def _steps(self, fields: FieldLibrary, assets: AssetLibrary, executor: Executor | None) -> Iterator[Any]:
        from osfcore.control.events import EpisodeSettings
        from osfcore.experiments.rearrangement import ORACLE_PLAN, EvaluateMpc, evaluate_mpc
        from osfcore.experiments.rearrangement_runs import Variant
        from osfcore.experiments.rivals.visual_foresight import ForesightSettings
        from osfcore.paper.mppi import GaussianPlanSettings
        from osfcore.planning.mppi import PlanSettings

        variant = Variant(self.method, frozenset(self.ours), frozenset(self.truths), self.views, self.masks)
        asked = {"samples": self.samples, "horizon": self.horizon}
        plan = {key: value for key, value in asked.items() if value is not None}
        config = EvaluateMpc(
            self.folder, self.data_dir, self.tasks, self.objects, self.seed, self.family, self.actions, variant,
            self.factor, self.cost, self.names, self.oracle, self.oracle_tries,
            EpisodeSettings(plan=PlanSettings(**plan)), replace(ORACLE_PLAN, samples=self.oracle_samples),
            GaussianPlanSettings(**plan), ForesightSettings(**plan),
        )  # fmt: skip
        return evaluate_mpc(config, fields, assets, executor)

    def _show(self, report: dict[str, Any]) -> None:
        _show_mpc(self.folder, report)


Evaluate = Annotated[
    Annotated[EvaluateFieldsCommand, tyro.conf.subcommand("fields")]
    | Annotated[EvaluateEstimateCommand, tyro.conf.subcommand("estimate")]
    | Annotated[EvaluateDynamicsCommand, tyro.conf.subcommand("dynamics")]
    | Annotated[EvaluateMpcCommand, tyro.conf.subcommand("mpc")]
    | Annotated[EvaluateRelightingCommand, tyro.conf.subcommand("relighting")]
    | Annotated[EvaluateVideoCommand, tyro.conf.subcommand("video")]
    | Annotated[EvaluatePhotosCommand, tyro.conf.subcommand("photos")],
    tyro.conf.OmitSubcommandPrefixes,
]


def _show_fields(result: dict[str, Any]) -> None:
    from rich.console import Console
    from rich.table import Table

    table = Table(box=None, pad_edge=False, padding=(0, 1, 0, 0))
    for title in ("object", "full dB", "mask dB", "SSIM", "MB", "minutes"):
        table.add_column(title, justify="left" if title == "object" else "right", no_wrap=True)
    for name, row in result["objects"].items():
        minutes = "" if row["minutes"] is None else f"{row['minutes']:.1f}"
        figures = (f"{row['psnr_full']:.2f}", f"{row['psnr_mask']:.2f}", f"{row['ssim']:.4f}", f"{row['file_mb']:.2f}")
        table.add_row(name, *figures, minutes)
    means = (f"{result['psnr_full_mean']:.2f}", f"{result['psnr_mask_mean']:.2f}", f"{result['ssim_mean']:.4f}")
    table.add_row("mean (size: most)", *means, f"{result['max_file_mb']:.2f}", "")
    console = Console()
    console.print(table)
    if result["scenes"]:
        shares = {"whole": "scene_psnr_mean", "objects": "scene_psnr_object_mean", "shadow": "scene_psnr_shadow_mean"}
        parts = [f"{what} {result[key]:.2f} dB" for what, key in shares.items() if result[key] is not None]
        console.print(f"{result['scenes']} scenes: {', '.join(parts)}", highlight=False)


def _show_estimate(folder: Path, result: dict[str, Any]) -> None:
    """The report for people, a line for each part."""
    print(
        f"First frames: {result['tasks']} scenes, {result['objects_total']} objects: "
        f"{_percent(result['frac_1cm_5deg'])} under 1 cm and 5 deg; medians {_errors(result)}, "
        f"ADD-S {_number(result['adds_mm_median'])} mm, {_number(result['first_s_median'])} s."
    )
    print(
        f"Claimed deviations: {_percent(result['two_sigma_coverage'])} of errors within two; "
        f"{_number(result['mean_position_std_mm'], 2)} mm on average. "
        f"Flagged: {_percent(result['flagged_good'])} of right estimates, "
        f"{_percent(result['flagged_bad'])} of wrong ones."
    )
    if result["track_episodes"] is not None:
        drift = ", ".join(f"{_number(mm)} mm after {step}" for step, mm in result["drift_mm"].items())
        print(
            f"Tracks: {result['track_lost']} of {result['track_episodes']} lost "
            f"({result['track_lost_from_wrong_start']} from a wrong first frame), {drift} steps; "
            f"{_number(result['refine_hz'])} Hz."
        )
    if result["goal_objects_total"] is not None:
        goals = {key.removeprefix("goal_"): value for key, value in result.items() if key.startswith("goal_")}
        print(
            f"Goals: {_percent(goals['frac_1cm_5deg'])} of {goals['objects_total']} objects under 1 cm and 5 deg; "
            f"medians {_errors(goals)}, {_number(goals['s_median'])} s."
        )
    if result["by_views"] is not None:
        rows = {f"{n} views" if n != "1" else "1 view": row for n, row in result["by_views"].items()}
        for what, row in {"light held overhead": result["fixed_light"], **rows}.items():
            print(f"  {what}: {_percent(row['frac_1cm_5deg'])} under 1 cm and 5 deg; medians {_errors(row)}")
    for name, row in result.get("by_factor", {}).items():
        print(
            f"  {name}: {_percent(row['frac_1cm_5deg'])} of {row['objects_total']} objects; medians {_errors(row)}, "
            f"{_percent(row['light_frac_10deg'])} of lights within 10 deg; {row['wrong_unflagged']} wrong without "
            f"a warning; {_number(row['first_s_median'])} s"
        )
    if "bad_cases" in result:
        print(
            f"Bad cases: {result['bad_cases']}: {result['bad_refused']} refused, {result['bad_flagged']} flagged, "
            f"{result['bad_right']} right, {result['bad_confident_wrong']} wrong without a warning."
        )
    print(f"Pictures and figures: {folder}")


def _show_dynamics(folder: Path, result: dict[str, Any]) -> None:
    """The report for people, a line for each part."""
    print(f"Three objects, {result['windows']} that moved within 4 steps of 0.2 s:")
    for horizon in (1, 4, 10, 30):
        mm, deg = result[f"median_mm_{horizon}"], result[f"median_deg_{horizon}"]
        others = [_number(result[f"{who}_mm_{horizon}"]) for who in ("constant", "analytic")]
        parts = f"constant pose {others[0]}, quasi-static {others[1]} mm"
        print(f"  after {horizon}: median {_number(mm)} mm, {_number(deg)} deg ({parts})")
    print(f"  what does not move drifts by {_number(result['still_drift_mm_30'], 2)} mm in 30 steps")
    for count, row in result["by_objects"].items():
        print(f"{count} objects: {_number(row['median_mm_4'])} mm, {_number(row['median_deg_4'])} deg after 4 steps")
    if result["unseen_objects"]:
        parts = (
            f"{_number(result['unseen_objects_mm_4'])} mm; having seen them {_number(result['seen_objects_mm_4'])} mm"
        )
        print(f"Objects never seen ({', '.join(result['unseen_objects'])}): {parts}")
    print(f"{result['rollout_steps_per_s']} steps of scenes a second. Pictures and figures: {folder}")


def _show_mpc(folder: Path, result: dict[str, Any]) -> None:
    """The report for people, a line for each part."""
    print(
        f"{result['tasks']} tasks of the family {result['family']!r} with {result['objects']} objects and "
        f"{result['actions']} actions, {result['cost']} cost:"
    )
    low, high = result["success_tight_interval"]
    print(
        f"{_percent(result['success_tight'])} within 2 cm and 0.1 rad ({100 * low:.0f} to {_percent(high)}), "
        f"{_percent(result['success_2cm'])} within 2 cm; {result['refused']} goals refused."
    )
    overruled = [_percent(result[f"success_{which}_overruled"]) for which in ("tight", "2cm")]
    print(f"With doubts about goals overruled: {overruled[0]} and {overruled[1]}.")
    moved = ", ".join(f"{_percent(share)} of {count}" for count, share in result["success_by_moved"].items())
    print(f"By number of objects that had to move: {moved}.")
    ends = f"{_number(result['final_mm_mean'])} mm (median {_number(result['final_mm_median'])} mm)"
    print(f"These end {ends} from their goals, from {_number(result['start_mm_mean'])} mm.")
    if result["oracle_success_2cm"] is not None:
        print(
            f"Told the truth, the same planner at its best: {_percent(result['oracle_success_tight'])} and "
            f"{_percent(result['oracle_success_2cm'])}, {_number(result['oracle_final_mm_mean'])} mm."
        )
    distances = [_number(result[f"{who}pose6d_symmetric_mean"], 3) for who in ("", "noaction_")]
    print(f"6D pose distance, symmetries considered: {distances[0]} on average, {distances[1]} without any action.")
    plan, look, whole = (result[f"{stage}_s_median"] for stage in ("replan", "estimate", "episode"))
    print(f"A plan takes {_number(plan)} s, an estimate {_number(look, 2)} s, an episode {_number(whole, 0)} s.")
    print(f"Pictures and figures: {folder}")


def _errors(row: dict[str, Any]) -> str:
    return (
        f"{_number(row['position_mm_median'])} mm, {_number(row['rotation_deg_median'])} deg, "
        f"light {_number(row['light_deg_median'])} deg"
    )


def _number(value: float | None, digits: int = 1) -> str:
    return "-" if value is None else f"{value:.{digits}f}"


def _percent(share: float | None) -> str:
    return "-" if share is None else f"{100 * share:.1f} %"
