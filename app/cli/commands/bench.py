"""`osf bench`: what things cost on this machine."""

from __future__ import annotations

from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Literal

import tyro

from app.cli.progress_bar import follow
from app.storage.paths import default_data_dir

_FIGURES, _PICTURE = "render.json", "render.png"
_ESTIMATE_FIGURES, _DYNAMICS_FIGURES = "estimate.json", "dynamics.json"
_SCENES = {"render": 60, "estimate": 5}


@dataclass(frozen=True)
class Bench:
    """Measure what things cost. Run alone on the machine.

    render: new scenes against TinyRenderer, planning, growth. estimate: first frames, later frames and goals.
    dynamics: 1,000 sequences of ten pushes among three objects.
    """

    what: tyro.conf.Positional[Literal["render", "estimate", "dynamics"]]
    """What to measure."""
    out: Path | None = None
    """Folder for the figures as JSON and, with render, a picture of scenes by TinyRenderer and by us."""
    seed: int = 0
    """Of all scenes."""
    scenes: int | None = None
    """New scenes; by default 60 to render and 5 to estimate."""
    repeats: int = 5
    """With render: of everything else."""
    device: Literal["auto", "cpu", "cuda"] = "cpu"
    """With dynamics: what computes."""
    data_dir: Path = field(default_factory=default_data_dir)
    """Where fetched objects and trained fields are."""
    json: bool = False
    """Print the result as one JSON object in the last line."""

    def run(self) -> dict[str, Any]:
        """Measure with a progress bar; the result holds figures and tables."""
        if self.what == "dynamics":
            return self._dynamics()
        scenes = _SCENES[self.what] if self.scenes is None else self.scenes
        return self._estimate(scenes) if self.what == "estimate" else self._render(scenes)

    def _render(self, scenes: int) -> dict[str, Any]:
        from osfcore.experiments.benchmarks.rendering import BenchRender, bench_render
        from osfcore.fields.field_library import FieldLibrary
        from osfcore.inspection.contact_sheet import contact_sheet
        from osfcore.io.files import write_json
        from osfcore.io.image_file import write_png
        from osfcore.objects.asset_library import AssetLibrary

        config = BenchRender(scenes=scenes, repeats=self.repeats, seed=self.seed)
        self._check_places(_FIGURES, _PICTURE)
        fields, assets = FieldLibrary(self.data_dir), AssetLibrary(self.data_dir / "objects")
        last = follow(bench_render(config, fields, assets))
        assert last is not None
        assert last.report is not None, "the last step brings the report"
        result = last.report.to_json()
        if self.out is not None:
            write_json(self.out / _FIGURES, result)
            write_png(self.out / _PICTURE, contact_sheet(last.report.shown, truth="Tiny"))
        if not self.json:
            _show(result)
        return result

    def _estimate(self, scenes: int) -> dict[str, Any]:
        from osfcore.experiments.benchmarks.estimation import BenchEstimate, bench_estimate
        from osfcore.fields.field_library import FieldLibrary
        from osfcore.io.files import write_json
        from osfcore.objects.asset_library import AssetLibrary

        self._check_places(_ESTIMATE_FIGURES)
        config = BenchEstimate(scenes=scenes, seed=self.seed)
        last = follow(bench_estimate(config, FieldLibrary(self.data_dir), AssetLibrary(self.data_dir / "objects")))
        assert last is not None
        assert last.report is not None, "the last step brings the report"
        result = last.report.to_json()
        if self.out is not None:
            write_json(self.out / _ESTIMATE_FIGURES, result)
        if not self.json:
            print(
                f"{result['scenes']} scenes of {result['objects']} objects, {result['threads']} threads, medians: "
                f"first frame {result['first_s']:.1f} s, later frame {result['next_s']:.2f} s "
                f"({result['refine_hz']:.1f} Hz), goal {result['goal_s']:.1f} s."
            )
        return result

    def _dynamics(self) -> dict[str, Any]:
        from dataclasses import asdict

        from osfcore.dynamics.network_weights import read_network
        from osfcore.dynamics.push_models import load_shapes, network_path
        from osfcore.experiments.benchmarks.rollouts import BENCH_NAMES, HORIZON, SEQUENCES, bench_rollouts
        from osfcore.fields.devices import pick_device
        from osfcore.fields.field_library import FieldLibrary
        from osfcore.io.files import write_json

        self._check_places(_DYNAMICS_FIGURES)
        shapes = load_shapes(self.data_dir, FieldLibrary(self.data_dir), BENCH_NAMES)
        result = asdict(bench_rollouts(read_network(network_path(self.data_dir)), shapes, pick_device(self.device)))
        if self.out is not None:
            write_json(self.out / _DYNAMICS_FIGURES, result)
        if not self.json:
            print(
                f"{SEQUENCES} sequences of {HORIZON} pushes among {len(BENCH_NAMES)} objects, {result['threads']} "
                f"threads: {result['rollout_s']:.2f} s; {result['rollout_steps_per_s']:.0f} steps of scenes a second; "
                f"something moves in {100 * result['touched_share']:.0f} % of the sequences."
            )
        return result

    def _check_places(self, *names: str) -> None:
        """Refuse what cannot be written before the work begins."""
        from osfcore.io.output_paths import check_place

        if self.out is not None:
            for name in names:
                check_place(self.out / name)


def _show(result: dict[str, Any]) -> None:
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
