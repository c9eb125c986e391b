"""How far an estimate is from the truth, which only a simulation knows. Estimators never see either."""

from __future__ import annotations

from typing import Any

import numpy as np

from osfcore.geometry.states import SceneState
from osfcore.objects.asset_library import AssetLibrary


def errors_of(found: SceneState, truth: SceneState, library: AssetLibrary) -> dict[str, Any]:
    """Distances of positions [mm], angles between orientations that look different [deg], and of the light [deg].

    Args:
        found: the estimate.
        truth: of the same objects.
        library: knows which rotations of an object look alike.
    """
    from osfcore.metrics.pose_errors import rotation_error

    objects = []
    for name in found.names:
        ours, true = found.pose(name), truth.pose(name)
        turn = rotation_error(library.info(name).symmetry, ours.quaternion, true.quaternion)
        shift_mm = 1000 * float(np.linalg.norm(ours.position - true.position))
        objects.append({"name": name, "position_mm": shift_mm, "rotation_deg": float(np.rad2deg(turn))})
    a, b = found.light.direction, truth.light.direction
    light = float(np.rad2deg(np.arctan2(np.linalg.norm(np.cross(a, b)), a @ b)))
    return {"objects": objects, "light_deg": light}
