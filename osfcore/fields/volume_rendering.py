"""Volume rendering in PyTorch: from densities at samples to the weight of each sample and to a pixel's value.

Emission and absorption along a ray r(t) = o + t d (paper eq. 3, NeRF eq. 1) are

    L = integral of T(t) sigma(r(t)) L_out(r(t)) dt,        T(t) = exp(-integral from t_n to t of sigma(r(s)) ds).

With density and radiance constant over intervals of length delta_i, this is exactly the sum

    tau_i   = sigma_i delta_i                               optical thickness
    alpha_i = 1 - exp(-tau_i)                               share of the light that interval i absorbs and scatters
    T_i     = exp(-sum of tau_j over j < i)                 share that reaches interval i
    w_i     = T_i alpha_i                                   weight of sample i
    L       = sum of w_i L_i + T_end L_behind,              T_end = exp(-sum of all tau_i).

A worked example: one ray with an empty sample and two that each let half of the light through.

    >>> taus = torch.log(torch.tensor([[1.0, 2.0, 2.0]]))
    >>> alphas_from_thickness(taus).tolist()
    [[0.0, 0.5, 0.5]]
    >>> transmittance(taus).tolist()
    [[1.0, 1.0, 0.5]]
    >>> weights = render_weights(taus)
    >>> weights.tolist()
    [[0.0, 0.5, 0.25]]
    >>> final_transmittance(taus).tolist()
    [0.25]
    >>> red_then_blue = torch.tensor([[[0.0, 0.0, 0.0], [1.0, 0.0, 0.0], [0.0, 0.0, 1.0]]])
    >>> accumulate_along_rays(weights, red_then_blue).tolist()
    [[0.5, 0.0, 0.25]]
"""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from osfcore.fields.kiloosf import STEP_VOXELS, KiloOSF
from osfcore.fields.kiloosf_query import Scatter
from osfcore.fields.rays import RayBatch, march


def alphas_from_thickness(taus: Float[Tensor, "*shape"]) -> Float[Tensor, "*shape"]:
    """Return the opacity of each sample, alpha_i = 1 - exp(-tau_i); exact for thin samples as well."""
    return -torch.expm1(-taus)


def transmittance(taus: Float[Tensor, "rays samples"]) -> Float[Tensor, "rays samples"]:
    """Return the share of the light that reaches each sample, T_i = exp(-sum of tau_j over j < i).

    Args:
        taus: optical thickness of each sample, in order of distance.
    """
    return torch.exp(-(torch.cumsum(taus, dim=1) - taus))


def final_transmittance(taus: Float[Tensor, "rays samples"]) -> Float[Tensor, "rays"]:
    """Return the share of the light that passes all samples, T_end."""
    return torch.exp(-taus.sum(dim=1))


def render_weights(taus: Float[Tensor, "rays samples"]) -> Float[Tensor, "rays samples"]:
    """Return the weight of each sample, w_i = T_i alpha_i; the weights of a ray and T_end sum to 1."""
    return transmittance(taus) * alphas_from_thickness(taus)


def accumulate_along_rays(
    weights: Float[Tensor, "rays samples"], values: Float[Tensor, "rays samples channels"]
) -> Float[Tensor, "rays channels"]:
    """Return the weighted sum of the samples' values: of colours the radiance, of distances the expected depth."""
    return (weights[..., None] * values).sum(dim=1)


def composite(
    query: Callable[[Tensor, Tensor, Tensor], Scatter], field: KiloOSF, rays: RayBatch, *, min_weight: float,
    most: int, offsets: np.ndarray | None = None, device: torch.device | str = "cpu",
) -> tuple[Float[Tensor, "R 3"], Float[Tensor, "R"]]:  # fmt: skip
    """Return the radiance over black and the opacity along rays that meet one object alone.

    Args:
        query: a `KiloQuery` or an `OSF`, called with points, lights and views.
        field: field whose density chooses the samples.
        rays: R rays.
        min_weight: smallest weight of a sample that is kept.
        most: largest number of samples per ray.
        offsets: offsets of each ray's first sample, in steps; 1/2 by default.
        device: device of `query`.
    """
    step = STEP_VOXELS * field.voxel
    ts, used = march(field, rays.origins, rays.directions, step=step, offsets=offsets, min_weight=min_weight,
                     most=most)  # fmt: skip
    mask = torch.as_tensor(used, device=device)
    ray = torch.as_tensor(np.nonzero(used)[0], device=device)
    points = (rays.origins[:, None] + ts[..., None] * rays.directions[:, None])[used]
    light, view = (torch.as_tensor(a, device=device)[ray] for a in (rays.lights, rays.directions))
    scatter = query(torch.as_tensor(points, device=device), light, view)
    weights = render_weights(torch.zeros(mask.shape, device=device).masked_scatter(mask, scatter.sigma * step))
    radiance = scatter.ambient + scatter.direct
    colour = torch.zeros(len(ts), 3, device=device).index_add(0, ray, weights[mask][:, None] * radiance)
    return colour, weights.sum(dim=1)
