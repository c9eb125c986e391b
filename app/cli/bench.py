"""`osf bench`: what things cost on this machine."""

from __future__ import annotations

from abc import abstractmethod
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any, ClassVar, Literal

from osfcore.io.files import write_json
from osfcore.io.output_paths import check_place

from .command import DataCommand, choice_of, report_of

_PICTURE = "render.png"


@dataclass(frozen=True)
class _Benchmark(DataCommand):
    """What all benchmarks share. Run alone on the machine."""

    FIGURES: ClassVar[str]  # the file that holds the result
    out: Path | None = None
    """Folder for the figures as JSON and, of rendering, a picture of scenes by TinyRenderer and by us."""

    def run(self) -> dict[str, Any]:
        """Measure with a progress bar; the result holds figures and tables."""
        if self.out is not None:  # before the work begins
            for name in (self.FIGURES, _PICTURE):
                check_place(self.out / name)
        result = self._measure()
        if self.out is not None:
            write_json(self.out / self.FIGURES, result)
        if not self.json:
            self._show(result)
        return result

    @abstractmethod
    def _measure(self) -> dict[str, Any]:
        """The figures."""

    @abstractmethod
    def _show(self, result: dict[str, Any]) -> None:
        """Print the figures for people."""


@dataclass(frozen=True)
class BenchRenderCommand(_Benchmark):
    """New scenes against TinyRenderer, planning, growth."""

    FIGURES: ClassVar[str] = "render.json"
    scenes: int = 60
    """New scenes."""
    repeats: int = 5
    """Of everything else."""
    seed: int = 0
    """Of all scenes."""

    def _measure(self) -> dict[str, Any]:
        from osfcore.experiments.bench_rendering import BenchRender, bench_render
        from osfcore.inspection.contact_sheet import contact_sheet
        from osfcore.io.image_file import write_png

        config = BenchRender(scenes=self.scenes, repeats=self.repeats, seed=self.seed)
        report = report_of(bench_render(config, self.trained, self.assets))
        if self.out is not None:
            write_png(self.out / _PICTURE, contact_sheet(report.shown, truth="Tiny"))
        return report.figures

    def _show(self, result: dict[str, Any]) -> None:
        print(
            f"New scene: TinyRenderer {result['tinyrenderer_ms']:.1f} ms, ours {result['scene_ms']:.1f} ms "
            f"({result['ratio']:.1f} times faster, {result['threads']} threads; "
            f"{result['ratio_exact']:.1f} times in exact quality); "
            f"reference {result['reference_ms']:.0f} ms.\n"
            f"Planning: {result['planning_renders_per_s']:.0f} renders a second, "
            f"{result['planning_psnr']:.1f} dB against exact ones."
        )
        for key, what in (("by_objects", "objects"), ("by_resolution", "px"), ("by_batch", "scenes in a call")):
            rows = ", ".join(f"{row['size']}: {row['ms']:.1f}" for row in result[key])
            print(f"Milliseconds by {what}: {rows}.")
        exponents = ", ".join(f"{key} {power:.2f}" for key, power in result["growth"].items() if power is not None)
        print(f"Growth (1 is in proportion): {exponents}.")


@dataclass(frozen=True)
class BenchEstimateCommand(_Benchmark):
    """First frames, later frames and goals."""

    FIGURES: ClassVar[str] = "estimate.json"
    scenes: int = 5
    """New scenes."""
    seed: int = 0
    """Of all scenes."""

    def _measure(self) -> dict[str, Any]:
        from osfcore.experiments.bench_estimation import BenchEstimate, bench_estimate

        config = BenchEstimate(scenes=self.scenes, seed=self.seed)
        return report_of(bench_estimate(config, self.trained, self.assets))

    def _show(self, result: dict[str, Any]) -> None:
        print(
            f"{result['scenes']} scenes of {result['objects']} objects, {result['threads']} threads, medians: "
            f"first frame {result['first_s']:.1f} s, later frame {result['next_s']:.2f} s "
            f"({result['refine_hz']:.1f} Hz), goal {result['goal_s']:.1f} s."
        )


@dataclass(frozen=True)
class BenchDynamicsCommand(_Benchmark):
    """1,000 sequences of ten pushes among three objects."""

    FIGURES: ClassVar[str] = "dynamics.json"
    device: Literal["auto", "cpu", "cuda"] = "cpu"
    """What computes."""

    def _measure(self) -> dict[str, Any]:
        from osfcore.dynamics.graph import read_network
        from osfcore.dynamics.rollout import PushModel, load_shapes, network_path
        from osfcore.experiments.bench_rollouts import BENCH_NAMES, bench_rollouts
        from osfcore.fields.devices import pick_device

        shapes = load_shapes(self.data_dir, self.trained, BENCH_NAMES)
        model = PushModel(read_network(network_path(self.data_dir)), shapes, pick_device(self.device))
        return asdict(bench_rollouts(model, shapes))

    def _show(self, result: dict[str, Any]) -> None:
        from osfcore.experiments.bench_rollouts import BENCH_NAMES, HORIZON, SEQUENCES

        print(
            f"{SEQUENCES} sequences of {HORIZON} pushes among {len(BENCH_NAMES)} objects, {result['threads']} "
            f"threads: {result['rollout_s']:.2f} s; {result['rollout_steps_per_s']:.0f} steps of scenes a second; "
            f"something moves in {100 * result['touched_share']:.0f} % of the sequences."
        )


@dataclass(frozen=True)
class BenchPlannerCommand(_Benchmark):
    """Our planner, the paper's and pytorch-mppi's on Push-T, given its true dynamics."""

    FIGURES: ClassVar[str] = "planner.json"
    tasks: int = 20
    """Start states."""
    samples: int = 64
    """Sequences that each plan looks at."""
    horizon: int = 15
    """Actions of 0.2 s in each of them."""
    steps: int = 50
    """Actions in an episode at most."""
    seed: int = 0
    """The environment's seed of the first task; the others follow."""

    def _measure(self) -> dict[str, Any]:
        from osfcore.experiments.pusht import BenchPlanner, bench_planner

        settings = {"samples": self.samples, "horizon": self.horizon, "steps": self.steps, "seed": self.seed}
        report = report_of(bench_planner(BenchPlanner(self.tasks, **settings)))
        return {**settings, **report}

    def _show(self, result: dict[str, Any]) -> None:
        print(
            f"{result['tasks']} tasks, {result['samples']} sequences of {result['horizon']} actions a plan, "
            f"one thread; coverage at the start {result['start_mean']:.2f}.\n"
            f"{'planner':14}{'success':>22}{'most coverage':>22}{'median':>8}{'least':>8}{'plans a second':>16}"
            f"{'plan: mean':>12}{'p90':>8}{'most':>8}{'without dynamics':>18}"
        )
        for name, row in result["planners"].items():
            low, high = (100 * limit for limit in row["success_interval"])
            success = f"{100 * row['success']:.0f} % ({low:.0f} to {high:.0f})"
            interval = row["coverage_interval"]
            spread = "" if interval is None else " ({:.2f} to {:.2f})".format(*interval)
            coverage = f"{row['coverage_mean']:.2f}{spread}"
            print(
                f"{name:14}{success:>22}{coverage:>22}{row['coverage_median']:>8.2f}{row['coverage_least']:>8.2f}"
                f"{row['plan_hz']:>13.1f} Hz{row['plan_s_mean']:>10.2f}{row['plan_s_p90']:>6.2f}"
                f"{row['plan_s_most']:>6.2f}{row['own_hz']:>15.0f} Hz"
            )


Bench = choice_of(
    render=BenchRenderCommand, estimate=BenchEstimateCommand, dynamics=BenchDynamicsCommand, planner=BenchPlannerCommand
)
