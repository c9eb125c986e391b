"""What is seen of a field's surface, one place and one colour per point, for formats without scattering functions."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import torch
from jaxtyping import Float, Float32

from osfcore.fields.kiloosf import STEP_VOXELS, KiloOSF
from osfcore.fields.kiloosf_query import KiloQuery
from osfcore.geometry.light import Light
from osfcore.render.volume_rendering import render_weights

_BEFORE_VOXELS, _BEHIND_VOXELS = 2.0, 4.0  # from where to where the surface is looked for
_LEAST_WEIGHT = 1e-6
_AT_ONCE = 32768  # points


@dataclass(frozen=True, eq=False, slots=True)
class Baked:
    """Points of a surface as cameras see them that look straight at each.

    Attributes:
        points: at the expected depth, in the field's frame [m].
        colours: linear radiance in [0, 1].
    """

    points: Float32[np.ndarray, "P 3"]
    colours: Float32[np.ndarray, "P 3"]


@torch.no_grad()
def baked(
    field: KiloOSF, points: Float[np.ndarray, "P 3"], normals: Float[np.ndarray, "P 3"], light: Light | None
) -> Baked:
    """Where along -n the surface is seen, and in which colour.

        x = p - t n,   c = rho(x, l, -n),   t = sum_i w_i t_i / sum_i w_i,   t_i from -2 to 4 voxels    (eqs. 1, 3)

    Args:
        field: of the object.
        points: p, on its surface, in its frame [m].
        normals: n, unit, outward.
        light: toward it, in the field's frame; None for one that falls along each point's own normal, under which
            ambient + diffuse = 1: c is then the albedo, as in `osfcore.photo.poses.surfels`.

    A trained field holds its own shadows; those of others are not there.

    Deviation from eq. 3: the radiance is taken at the expected depth, not integrated along the ray.
    """
    query = KiloQuery(field)
    t = torch.arange(-_BEFORE_VOXELS, _BEHIND_VOXELS, STEP_VOXELS) * query.voxel
    parts = [np.zeros((2, 0, 3), np.float32)]
    for start in range(0, len(points), _AT_ONCE):
        p, n = (torch.as_tensor(a[start : start + _AT_ONCE], dtype=torch.float32) for a in (points, normals))
        x = p[:, None] - t[:, None] * n[:, None]
        taus = query.density(x.reshape(-1, 3)).view(x.shape[:2]) * STEP_VOXELS * query.voxel
        weights = render_weights(taus) + _LEAST_WEIGHT  # where nothing is dense, p is nearly the mean
        depth = (weights * t).sum(dim=1, keepdim=True) / weights.sum(dim=1, keepdim=True)
        toward = n if light is None else torch.as_tensor(light.direction, dtype=torch.float32).expand_as(n)
        seen = p - depth * n
        scatter = query(seen, toward, -n)
        parts.append(torch.stack([seen, (scatter.ambient + scatter.direct).clamp(0, 1)]).numpy())
    return Baked(*np.concatenate(parts, axis=1))
