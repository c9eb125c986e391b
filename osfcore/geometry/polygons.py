"""Outlines of objects seen from above, and gaps between them: plane geometry on batches of convex polygons.

A polygon is given by its farthest points in K equally spaced directions, the first along +x, counterclockwise; points
may repeat.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import torch
from jaxtyping import Float, Int
from torch import Tensor


class Gap(NamedTuple):
    """The gap between a convex outline and something else.

    Attributes:
        distance: between the two [m]; negative where they overlap.
        normal: unit vector out of the outline, toward the other.
        point: point of the outline, where the two are closest [m].
    """

    distance: Float[Tensor, "A"]
    normal: Float[Tensor, "A 2"]
    point: Float[Tensor, "A 2"]


def circle(count: int, device: torch.device | None = None) -> Float[Tensor, "K 2"]:
    """Unit vectors in `count` equally spaced directions, the first along +x, counterclockwise."""
    angles = torch.arange(count, device=device) * (2 * math.pi / count)
    return torch.stack([angles.cos(), angles.sin()], dim=-1)


def dot(a: Float[Tensor, "*#batch 2"], b: Float[Tensor, "*#batch 2"]) -> Float[Tensor, "*out"]:
    """Scalar products; written out, for sums over a short last axis are slow."""
    return a[..., 0] * b[..., 0] + a[..., 1] * b[..., 1]


def gap_to_point(outline: Float[Tensor, "A K 2"], point: Float[Tensor, "A 2"]) -> Gap:
    """Return the gaps from outlines to one point each."""
    side = outline.roll(-1, dims=1) - outline
    away = point[:, None] - outline
    along = dot(away, side) / (dot(side, side) + 1e-12)
    rest = away - along.clamp(0, 1)[..., None] * side
    nearest = dot(rest, rest).argmin(dim=1)
    rest = rest[torch.arange(len(rest), device=rest.device), nearest]
    length = (dot(rest, rest) + 1e-14).sqrt()
    reached = point - rest
    outward = dot(rest, reached - outline.mean(dim=1))  # a convex outline's nearest point lies away from its middle
    sign = torch.where(outward < 0, -1.0, 1.0)
    return Gap(sign * length, (sign / length)[:, None] * rest, reached)


def gap_between(first: Float[Tensor, "E K 2"], second: Float[Tensor, "E K 2"]) -> Gap:
    """Return the gaps from first to second outlines, by the best separating axis among the normals of their sides.

    The distance is exact for overlapping outlines and where a side is involved, and too small between two corners.
    """
    rows = torch.arange(len(first), device=first.device)
    best = _separation(first, second)
    other = _separation(second, first)
    is_first = best[0] >= other[0]
    distance = torch.where(is_first, best[0], other[0])
    normal = torch.where(is_first[:, None], best[1], -other[1])
    point = first[rows, direction_index(normal, first.shape[1])]
    return Gap(distance, normal, point)


def _separation(first: Tensor, second: Tensor) -> tuple[Tensor, Tensor]:
    """Return the largest separation along the normals of the first outlines' sides [m], and that normal."""
    side = first.roll(-1, dims=1) - first
    length = (dot(side, side) + 1e-16).sqrt()
    normal = torch.stack([side[..., 1], -side[..., 0]], dim=-1) / length[..., None]
    # Not from the side's own corner: points found with an error may run back a little before they go on.
    nearest = torch.matmul(normal, second.transpose(1, 2)).amin(dim=2)
    reach = nearest - torch.matmul(normal, first.transpose(1, 2)).amax(dim=2)
    reach = torch.where(length > 1e-4, reach, -1.0)  # repeated points have no side between them
    best = reach.argmax(dim=1)
    rows = torch.arange(len(first), device=first.device)
    return reach[rows, best], normal[rows, best]


def direction_index(direction: Float[Tensor, "A 2"], count: int) -> Int[Tensor, "A"]:
    """Return the number of the nearest of `count` equally spaced directions."""
    angle = torch.atan2(direction[:, 1], direction[:, 0])
    return (angle * (count / (2 * math.pi))).round().long() % count
