"""`osf estimate`: poses and light from an observation folder."""

from __future__ import annotations

import time
from collections.abc import Iterator
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal

from app.cli.progress_bar import follow
from app.storage.paths import default_data_dir
from osfcore.errors import InvalidInput

if TYPE_CHECKING:
    from osfcore.estimation.objective import ObjectModels
    from osfcore.estimation.steps import EstimateStep
    from osfcore.geometry.states import EstimatedState, Observation


@dataclass(frozen=True)
class Estimate:
    """Find where known objects lie, and the light, in images of them; no depth, no meshes."""

    observation: Path
    """Folder with observation.json and its images; masks are needed unless there is a prior."""
    out: Path
    """state.json to write."""
    prior: Path | None = None
    """state.json or scene.json: of a goal, how the objects lie now; else the frame before, or what was predicted."""
    goal: bool = False
    """A goal image: one view without masks, in which the objects may be anywhere and the light another."""
    method: Literal["ours", "paper"] = "ours"
    """How: ours; the paper's as published, CMA-ES alone with its own fields."""
    seed: int = 0
    """Of the searches."""
    images: Path | None = None
    """Folder for a PNG of each camera: observed, rendered from the estimate, difference x 4."""
    data_dir: Path = field(default_factory=default_data_dir)
    """Where fields trained on this machine are."""
    json: bool = False
    """Print the result as one JSON object in the last line."""

    def run(self) -> dict[str, Any]:
        """Estimate; the result is what state.json holds, and how long it took."""
        from app.jobs.kinds.estimates import load_models, steps_of
        from osfcore.errors import check_seed
        from osfcore.io.observation_file import read_observation
        from osfcore.io.scene_file import estimated_to_json, read_estimated, write_estimated
        from osfcore.random_streams import Stream, stream_rng

        rng = stream_rng(check_seed(self.seed), Stream.FIRST_FRAME)
        self._check_places()
        if self.goal and self.prior is None:
            raise InvalidInput("--prior", "missing", "given: how the objects lie now")
        observation = read_observation(self.observation)
        prior = None if self.prior is None else read_estimated(self.prior).state
        models = load_models(self.data_dir, observation.names, self.method)
        start = time.perf_counter()
        mode = "goal" if self.goal else "first" if prior is None else "next"
        estimate = _last(steps_of(mode, models, observation, prior, rng, self.method))
        seconds = round(time.perf_counter() - start, 2)
        write_estimated(self.out, estimate)
        if not self.json:
            print("\n".join(_summary(estimate)))
            print(f"Wrote {self.out} after {seconds:.1f} s.")
        if self.images is not None:
            _write_sheets(self.images, models, observation, estimate)
            if not self.json:
                print(f"{self.images} shows observed and rendered images of {len(observation.cameras)} cameras.")
        return {**estimated_to_json(estimate), "seconds": seconds}

    def _check_places(self) -> None:
        """Refuse what cannot be written, or would overwrite what is read, before the work begins."""
        from osfcore.io.observation_file import OBSERVATION_FILE
        from osfcore.io.output_paths import check_place

        if self.out.suffix.lower() != ".json":
            raise InvalidInput("output file", self.out, "a path that ends in .json")
        if self.out.resolve() == (self.observation / OBSERVATION_FILE).resolve():
            raise InvalidInput("output file", self.out, "another file than the observation")
        check_place(self.out)
        if self.images is not None:
            check_place(_sheet_path(self.images, 0))


@dataclass(frozen=True)
class _Shown:
    """A step as a progress bar takes it."""

    step: EstimateStep

    @property
    def done(self) -> int:
        return self.step.progress.done

    @property
    def total(self) -> int:
        return self.step.progress.total

    @property
    def note(self) -> str:
        return self.step.progress.note


def _last(steps: Iterator[EstimateStep]) -> EstimatedState:
    """Run through the steps and show them; what the last one holds."""
    last = follow(_Shown(step) for step in steps)
    assert last is not None
    assert last.step.estimate is not None
    return last.step.estimate


def _summary(estimate: EstimatedState) -> list[str]:
    """The estimate for people: a line for each object, one for the light, one for the trust."""
    import numpy as np

    from osfcore.errors import shown

    names = [shown(name, 40) for name in estimate.state.names]
    width = max(len(name) for name in (*names, "object"))
    lines = [f"{'object':<{width}}  {'position [cm]':>23}  {'+- [mm]':>8}  {'turn +- [deg]':>13}  doubt"]
    rows = zip(
        names, estimate.state.poses.position, estimate.position_std, estimate.rotation_std, estimate.doubts, strict=True
    )
    for name, position, std, turn, doubt in rows:
        place = " ".join(f"{100 * value:7.2f}" for value in position)
        lines.append(f"{name:<{width}}  {place}  {1000 * std:8.2f}  {np.rad2deg(turn):13.2f}  {shown(doubt) or '-'}")
    x, y, z = estimate.state.light.direction
    azimuth, elevation = np.rad2deg(np.arctan2(y, x)), np.rad2deg(np.arcsin(np.clip(z, -1, 1)))
    deviation = np.rad2deg(estimate.light_std)
    lines.append(f"Light: azimuth {azimuth:.1f} deg, elevation {elevation:.1f} deg, +- {deviation:.2f} deg.")
    lines.append("Trusted." if estimate.trusted else f"NOT TRUSTED: {shown(estimate.reason, 1000)}.")
    return lines


def _write_sheets(folder: Path, models: ObjectModels, observation: Observation, estimate: EstimatedState) -> None:
    """One sheet for each camera: what was observed, what the estimate looks like, and the difference."""
    from osfcore.errors import shown
    from osfcore.inspection.contact_sheet import Comparison, contact_sheet
    from osfcore.io.image_file import to_uint8, write_png
    from osfcore.metrics.image_errors import psnr
    from osfcore.render.types import Quality, SceneBatch

    batch, quality = SceneBatch.of(estimate.state), Quality(samples_per_side=2)
    rendered = models.together.render(batch, observation.cameras, quality=quality).rgb[0]
    for view, camera in enumerate(observation.cameras):
        observed, ours = observation.images[view], rendered[view]
        label = f"{shown(camera.name, 20)}: {psnr(observed, ours):.1f} dB"
        sheet = contact_sheet([Comparison(label, to_uint8(observed), to_uint8(ours))], truth="observed")
        write_png(_sheet_path(folder, view), sheet)


def _sheet_path(folder: Path, view: int) -> Path:
    return folder / f"comparison_{view}.png"
