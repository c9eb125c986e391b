"""`osf bench`: what things cost on this machine."""

from __future__ import annotations

from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Literal

import tyro

from app.commands.progress_bar import follow
from app.paths import default_data_dir

_FIGURES, _PICTURE = "render.json", "render.png"


@dataclass(frozen=True)
class Bench:
    """Measure what rendering costs: new scenes against TinyRenderer, planning, growth. Run alone on the machine."""

    what: tyro.conf.Positional[Literal["render"]]
    """What to measure."""
    out: Path | None = None
    """Folder for render.json and a picture of scenes by TinyRenderer and by us."""
    seed: int = 0
    """Of all scenes."""
    scenes: int = 60
    """New scenes against TinyRenderer."""
    repeats: int = 5
    """Of everything else."""
    data_dir: Path = field(default_factory=default_data_dir)
    """Where fetched objects and trained fields are."""
    json: bool = False
    """Print the result as one JSON object in the last line."""

    def run(self) -> dict[str, Any]:
        """Measure with a progress bar; the result holds figures and tables."""
        from osfcore.evaluate.bench_render import BenchRender, bench_render
        from osfcore.evaluate.images import contact_sheet, write_png
        from osfcore.fields.library import FieldLibrary
        from osfcore.fields.outputs import check_place
        from osfcore.files import write_json
        from osfcore.objects.library import AssetLibrary

        config = BenchRender(scenes=self.scenes, repeats=self.repeats, seed=self.seed)
        for path in (self.out / _FIGURES, self.out / _PICTURE) if self.out is not None else ():
            check_place(path)
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
