"""Show a predicted future as pictures, beside those of the simulator (paper, figure 6)."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import closing
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from jaxtyping import Float

from osfcore.geometry.cameras import Camera
from osfcore.geometry.poses import Pose
from osfcore.geometry.rollouts import Rollouts
from osfcore.geometry.states import SceneState
from osfcore.inspection.contact_sheet import Comparison, contact_sheet
from osfcore.io.files import write_json
from osfcore.io.image_file import to_uint8, write_png
from osfcore.metrics.image_errors import psnr
from osfcore.objects.asset_library import AssetLibrary
from osfcore.progress import Progress
from osfcore.render.renderer import SceneRenderer
from osfcore.render.types import Quality, SceneBatch

PSNR_FILE, SHEET_FILE = "psnr.json", "prediction.png"
_MOST_COLUMNS = 11  # of the contact sheet
_QUALITY = Quality(samples_per_side=2)


@dataclass(frozen=True, eq=False, slots=True)
class VisualPrediction:
    """One rollout to be shown.

    Attributes:
        state: what it starts from.
        rollouts: what is predicted.
        actions: of these rollouts [m/s].
        sequence: index of the one that is shown.
        camera: of the pictures.
        folder: for STEP.png (predicted), STEP_true.png, the contact sheet prediction.png and psnr.json.
    """

    state: SceneState
    rollouts: Rollouts
    actions: Float[np.ndarray, "K T 3"]
    sequence: int
    camera: Camera
    folder: Path


def show_prediction(
    request: VisualPrediction, renderer: SceneRenderer, assets: AssetLibrary | None
) -> Iterator[Progress]:
    """Render each step through the fields and, where meshes are there, simulate and trace it.

    Args:
        request: what to show.
        renderer: of all objects of the state.
        assets: meshes of all objects of the state; None to leave the simulator out.

    Raises:
        OverlappingObjects, InvalidInput: if the simulator cannot begin from the state.
        CannotWrite: if the disk refuses.
    """
    rollouts, k = request.rollouts, request.sequence
    predicted = zip(rollouts.positions[k], rollouts.quaternions[k], rollouts.pusher[k], strict=True)
    states = [SceneState(rollouts.names, Pose(p, q), request.state.light, pusher) for p, q, pusher in predicted]
    truth = None if assets is None else _simulated(request, assets)
    columns, psnrs = [], []
    for step, state in enumerate(states):
        yield Progress(step, len(states), f"Rendering step {step} of {len(states) - 1}")
        ours = renderer.render(SceneBatch.of(state), (request.camera,), quality=_QUALITY).rgb[0, 0]
        write_png(request.folder / f"{step:03d}.png", to_uint8(ours))
        if truth is not None:
            true = next(truth)
            write_png(request.folder / f"{step:03d}_true.png", to_uint8(true))
            psnrs.append(round(psnr(true, ours), 3))
            columns.append(Comparison(f"{step}: {psnrs[-1]:.1f} dB", to_uint8(true), to_uint8(ours)))
    if columns:
        stride = -(-len(columns) // _MOST_COLUMNS)
        sheet = contact_sheet(columns[::stride], per_row=_MOST_COLUMNS, truth="simulator")
        write_png(request.folder / SHEET_FILE, sheet)
        write_json(request.folder / PSNR_FILE, {"camera": request.camera.name, "psnr": psnrs})
    yield Progress(len(states), len(states), "Everything is rendered")


def _simulated(request: VisualPrediction, assets: AssetLibrary) -> Iterator[Float[np.ndarray, "h w 3"]]:
    """Yield what the camera would truly see."""
    from osfcore.world.tabletop import Tabletop  # predictions alone do without the simulator

    with closing(Tabletop(assets, cameras=(request.camera,))) as world:
        world.restore(request.state)
        yield world.observe().images[0]
        for action in request.actions[request.sequence]:
            world.act(action)
            yield world.observe().images[0]
