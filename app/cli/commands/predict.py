"""`osf predict`: what sequences of pushes would do."""

from __future__ import annotations

import time
from collections.abc import Callable
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal

from app.cli.progress_bar import follow
from app.storage.paths import default_data_dir
from osfcore.errors import InvalidInput

if TYPE_CHECKING:
    import numpy as np

    from osfcore.dynamics.dynamics_model import DynamicsModel
    from osfcore.geometry.cameras import Camera
    from osfcore.geometry.rollouts import Rollouts
    from osfcore.geometry.states import SceneState


@dataclass(frozen=True)
class Predict:
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
    device: Literal["auto", "cpu", "cuda"] = "auto"
    """What computes; auto takes a GPU where there is one."""
    data_dir: Path = field(default_factory=default_data_dir)
    """Where fetched objects, and fields and networks trained on this machine, are."""
    json: bool = False
    """Print the result as one JSON object in the last line."""

    def run(self) -> dict[str, Any]:
        """Predict; the result tells how far each object goes at most [mm], and PSNR by step where it is known."""
        from osfcore.fields.devices import pick_device
        from osfcore.fields.field_library import FieldLibrary
        from osfcore.io.output_paths import check_place
        from osfcore.io.scene_file import read_actions, read_estimated, write_rollouts

        if self.out.suffix.lower() != ".json":
            raise InvalidInput("output file", self.out, "a path that ends in .json")
        check_place(self.out)
        state, actions = read_estimated(self.state).state, read_actions(self.actions)
        before = None if self.before is None else read_estimated(self.before).state
        if self.images is not None and not 0 <= self.sequence < len(actions):
            raise InvalidInput("sequence", self.sequence, f"between 0 and {len(actions) - 1}")
        camera = self._camera() if self.images is not None else None
        load = self._loader()
        model = load(self.data_dir, FieldLibrary(self.data_dir), state.names, pick_device(self.device))
        start = time.perf_counter()
        rollouts = model.rollout(state, actions, before)
        seconds = time.perf_counter() - start
        write_rollouts(self.out, rollouts)
        result = self._result(rollouts, seconds)
        if self.images is not None and camera is not None:
            result |= self._pictures(self.images, state, actions, rollouts, camera)
        if not self.json:
            _show(result)
        return result

    def _loader(self) -> Callable[..., DynamicsModel]:
        from osfcore.dynamics.rollout import load_push_model
        from osfcore.paper.dynamics import load_paper_push_model

        return load_paper_push_model if self.method == "paper" else load_push_model

    def _result(self, rollouts: Rollouts, seconds: float) -> dict[str, Any]:
        import numpy as np

        way = np.linalg.norm(rollouts.positions - rollouts.positions[:, :1], axis=-1).max(axis=(0, 1))
        count, times = rollouts.positions.shape[:2]
        moved = {name: round(1e3 * float(mm), 3) for name, mm in zip(rollouts.names, way, strict=True)}
        return {"out": str(self.out), "sequences": count, "steps": times - 1, "seconds": round(seconds, 4),
                "farthest_mm": moved}  # fmt: skip

    def _camera(self) -> Camera:
        from osfcore.geometry.cameras import default_cameras, goal_camera
        from osfcore.io.files import read_json
        from osfcore.io.scene_file import scene_from_json

        own = read_json(self.state, scene_from_json).cameras
        known = {camera.name: camera for camera in (*default_cameras(), goal_camera(), *own)}
        if self.camera not in known:
            raise InvalidInput("camera", self.camera, f"one of {', '.join(known)}")
        return known[self.camera]

    def _pictures(
        self, folder: Path, state: SceneState, actions: np.ndarray, rollouts: Rollouts, camera: Camera
    ) -> dict[str, Any]:
        """Draw one sequence; PSNR by step where the simulator could be asked."""
        from osfcore.experiments.visual_prediction import PSNR_FILE, VisualPrediction, show_prediction
        from osfcore.extras import missing
        from osfcore.fields.devices import pick_device
        from osfcore.fields.field_library import FieldLibrary
        from osfcore.io.files import read_json
        from osfcore.objects.asset_library import AssetLibrary
        from osfcore.render.renderer import SceneRenderer

        library, assets = FieldLibrary(self.data_dir), AssetLibrary(self.data_dir / "objects")
        fields = {name: library.load(name) for name in state.names}
        renderer = SceneRenderer(fields, library.load_table(), device=str(pick_device(self.device)))
        lacking = missing("sim") or [name for name in state.names if not assets.has(name)]
        request = VisualPrediction(state, rollouts, actions, self.sequence, camera, folder)
        follow(show_prediction(request, renderer, None if lacking else assets))
        if lacking:
            return {"images": str(folder), "psnr": None, "lacking": lacking}
        return {"images": str(folder), "psnr": read_json(folder / PSNR_FILE, _psnr)}


def _psnr(content: object) -> list[float]:
    assert isinstance(content, dict)
    return content["psnr"]


def _show(result: dict[str, Any]) -> None:
    print(f"{result['sequences']} x {result['steps']} actions predicted in {result['seconds']:.2f} s.")
    for name, mm in result["farthest_mm"].items():
        print(f"  {name}: {f'goes up to {mm:.0f} mm' if mm else 'stays where it is'}")
    print(f"Wrote {result['out']}.")
    if result.get("psnr"):
        print(f"{result['images']}: PSNR {', '.join(f'{value:.1f}' for value in result['psnr'])} dB by step.")
    elif "images" in result:
        print(f"{result['images']}: predictions alone; the simulator lacks {', '.join(result['lacking'])}.")
