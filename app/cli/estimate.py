"""`osf estimate`, `osf predict` and `osf render`: what lies on a table, what pushes would do, and how it looks."""

from __future__ import annotations

import json
import time
from collections.abc import Iterable, Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal

from osfcore.errors import InvalidInput, check_seed, shown
from osfcore.io.output_paths import check_place
from osfcore.random_streams import Stream, stream_rng

from .command import DataCommand, Device, check_out, follow, last_of

if TYPE_CHECKING:
    import numpy as np

    from osfcore.estimation.objective import ObjectModels
    from osfcore.fields.field_library import FieldLibrary
    from osfcore.geometry.cameras import Camera
    from osfcore.geometry.rollouts import Rollouts
    from osfcore.geometry.states import EstimatedState, Observation, SceneState
    from osfcore.render.renderer import SceneRenderer


@dataclass(frozen=True)
class Estimate(DataCommand):
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

    def run(self) -> dict[str, Any]:
        """Estimate; the result is what state.json holds, and how long it took."""
        from osfcore.io.observation_file import OBSERVATION_FILE, read_observation
        from osfcore.io.scene_file import estimated_to_json, read_estimated, write_estimated

        from ..jobs.kinds.estimates import load_models, steps_of

        rng = stream_rng(check_seed(self.seed), Stream.FIRST_FRAME)
        check_out(self.out, ".json")
        if self.out.resolve() == (self.observation / OBSERVATION_FILE).resolve():
            raise InvalidInput("output file", self.out, "another file than the observation")
        if self.images is not None:
            check_place(_sheet_path(self.images, 0))
        if self.goal and self.prior is None:
            raise InvalidInput("--prior", "missing", "given: how the objects lie now")
        observation = read_observation(self.observation)
        prior = None if self.prior is None else read_estimated(self.prior).state
        models = load_models(self.data_dir, observation.names, self.method)
        start = time.perf_counter()
        mode = "goal" if self.goal else "first" if prior is None else "next"
        estimate = last_of(steps_of(mode, models, observation, prior, rng, self.method)).estimate
        assert estimate is not None, "the last step brings the estimate"
        seconds = round(time.perf_counter() - start, 2)
        write_estimated(self.out, estimate)
        self.say(*_summary(estimate), f"Wrote {self.out} after {seconds:.1f} s.")
        if self.images is not None:
            _write_sheets(self.images, models, observation, estimate)
            self.say(f"{self.images} shows observed and rendered images of {len(observation.cameras)} cameras.")
        return {**estimated_to_json(estimate), "seconds": seconds}


def _summary(estimate: EstimatedState) -> list[str]:
    """The estimate for people: a line for each object, one for the light, one for the trust."""
    import numpy as np

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


@dataclass(frozen=True)
class Predict(DataCommand):
    """Predict where objects will be after each push of each sequence, from their poses now."""

    state: Path
    """state.json or scene.json, with the pusher."""
    actions: Path
    """actions.json: sequences of pusher velocities [m/s], each held for 0.2 s."""
    out: Path
    """rollouts.json to write."""
    before: Path | None = None
    """state.json of 0.2 s ago; without it, everything is taken to rest."""
    images: Path | None = None
    """Folder for pictures of one sequence: predicted through the fields, beside the simulator's where meshes are."""
    camera: str = "0"
    """With --images: a camera of the scene.json, one of the four default ones (0 to 3), or goal."""
    sequence: int = 0
    """With --images: which sequence."""
    method: Literal["ours", "paper"] = "ours"
    """Whose model: ours; the paper's as published, for which --before plays no part."""
    device: Device = "auto"

    def run(self) -> dict[str, Any]:
        """Predict; the result has how far each object goes at most [mm], and PSNR by step where it is known."""
        import numpy as np

        from osfcore.dynamics.rollout import load_push_model
        from osfcore.fields.devices import pick_device
        from osfcore.geometry.cameras import default_cameras, goal_camera
        from osfcore.io.scene_file import read_actions, read_estimated, read_scene, write_rollouts
        from osfcore.paper.dynamics import load_paper_push_model

        check_out(self.out, ".json")
        state, actions = read_estimated(self.state).state, read_actions(self.actions)
        before = None if self.before is None else read_estimated(self.before).state
        if self.images is not None and not 0 <= self.sequence < len(actions):
            raise InvalidInput("sequence", self.sequence, f"between 0 and {len(actions) - 1}")
        camera = None
        if self.images is not None:
            camera = _camera(self.camera, (*default_cameras(), goal_camera(), *read_scene(self.state).cameras))
        load = load_paper_push_model if self.method == "paper" else load_push_model
        model = load(self.data_dir, self.trained, state.names, pick_device(self.device))
        start = time.perf_counter()
        rollouts = model.rollout(state, actions, before)
        seconds = time.perf_counter() - start
        write_rollouts(self.out, rollouts)
        way = np.linalg.norm(rollouts.positions - rollouts.positions[:, :1], axis=-1).max(axis=(0, 1))
        count, times = rollouts.positions.shape[:2]
        result: dict[str, Any] = {
            "out": str(self.out), "sequences": count, "steps": times - 1, "seconds": round(seconds, 4),
            "farthest_mm": {name: round(1e3 * float(m), 3) for name, m in zip(rollouts.names, way, strict=True)},
        }  # fmt: skip
        if self.images is not None and camera is not None:
            result |= self._pictures(self.images, state, actions, rollouts, camera)
        self.say(*_prediction_text(result))
        return result

    def _pictures(
        self, folder: Path, state: SceneState, actions: np.ndarray, rollouts: Rollouts, camera: Camera
    ) -> dict[str, Any]:
        """Draw one sequence; PSNR by step where the simulator could be asked."""
        from osfcore.experiments.visual_prediction import PSNR_FILE, VisualPrediction, show_prediction
        from osfcore.extras import missing

        assets = self.assets
        renderer = _renderer(self.trained, state.names, self.device)
        lacking = missing("sim") or [name for name in state.names if not assets.has(name)]
        request = VisualPrediction(state, rollouts, actions, self.sequence, camera, folder)
        follow(show_prediction(request, renderer, None if lacking else assets))
        if lacking:
            return {"images": str(folder), "psnr": None, "lacking": lacking}
        return {"images": str(folder), "psnr": json.loads((folder / PSNR_FILE).read_text(encoding="utf-8"))["psnr"]}


def _prediction_text(result: dict[str, Any]) -> Iterator[str]:
    """What a prediction says, for people."""
    yield f"{result['sequences']} x {result['steps']} actions predicted in {result['seconds']:.2f} s."
    for name, mm in result["farthest_mm"].items():
        yield f"  {name}: {f'goes up to {mm:.0f} mm' if mm else 'stays where it is'}"
    yield f"Wrote {result['out']}."
    if result.get("psnr"):
        yield f"{result['images']}: PSNR {', '.join(f'{value:.1f}' for value in result['psnr'])} dB by step."
    elif "images" in result:
        yield f"{result['images']}: predictions alone; the simulator lacks {', '.join(result['lacking'])}."


@dataclass(frozen=True)
class Render(DataCommand):
    """Render a scene with neural fields: relit, with shadows, without any mesh."""

    scene: Path
    """scene.json with objects, light, pusher and perhaps cameras, or the state.json of an estimate."""
    out: Path
    """PNG to write."""
    camera: str = "0"
    """Name of one of the scene's cameras; of 0 to 3 and goal, the usual ones, if it has none."""
    device: Device = "auto"

    def run(self) -> dict[str, Any]:
        """Render with two by two rays a pixel; the result has the file and its size."""
        from osfcore.geometry.cameras import default_cameras, goal_camera
        from osfcore.io.image_file import to_uint8, write_png
        from osfcore.io.scene_file import read_scene
        from osfcore.render.types import Quality, SceneBatch

        check_out(self.out, ".png")
        scene = read_scene(self.scene)
        camera = _camera(self.camera, scene.cameras or (*default_cameras(), goal_camera()))
        renderer, quality = _renderer(self.trained, scene.state.names, self.device), Quality(samples_per_side=2)
        pixels = to_uint8(renderer.render(SceneBatch.of(scene.state), (camera,), quality=quality).rgb[0, 0])
        write_png(self.out, pixels)
        height, width = pixels.shape[:2]
        self.say(f"Wrote {self.out}, {width} x {height} px.")
        return {"out": str(self.out), "width": width, "height": height, "objects": list(scene.state.names)}


def _camera(name: str, cameras: Iterable[Camera]) -> Camera:
    known = {camera.name: camera for camera in cameras}
    if name not in known:
        raise InvalidInput("camera", name, f"one of {', '.join(known)}")
    return known[name]


def _renderer(library: FieldLibrary, names: Iterable[str], device: str) -> SceneRenderer:
    """A renderer of these objects and the table."""
    from osfcore.fields.devices import pick_device
    from osfcore.render.renderer import SceneRenderer

    fields = {name: library.load(name) for name in names}
    return SceneRenderer(fields, library.load_table(), device=str(pick_device(device)))
