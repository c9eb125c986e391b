"""Rotations on torch tensors as quaternions (w, x, y, z), like `osfcore.geometry.poses` for numpy."""

from __future__ import annotations

import torch
from jaxtyping import Float
from torch import Tensor


def multiply(a: Float[Tensor, "*batch 4"], b: Float[Tensor, "*batch 4"]) -> Float[Tensor, "*batch 4"]:
    """Hamilton product a b: the rotation b followed by the rotation a."""
    aw, au = a[..., :1], a[..., 1:]
    bw, bu = b[..., :1], b[..., 1:]
    scalar = aw * bw - (au * bu).sum(dim=-1, keepdim=True)
    return torch.cat([scalar, aw * bu + bw * au + torch.linalg.cross(au, bu)], dim=-1)


def unit(q: Float[Tensor, "*batch 4"]) -> Float[Tensor, "*batch 4"]:
    """Return the same quaternions with norm 1."""
    return q / q.norm(dim=-1, keepdim=True)


def exponential(rotation_vector: Float[Tensor, "*batch 3"]) -> Float[Tensor, "*batch 4"]:
    """Unit quaternions of rotation vectors [rad]; smooth at 0."""
    half = (rotation_vector.square().sum(dim=-1, keepdim=True) + 1e-20).sqrt() / 2
    return torch.cat([half.cos(), rotation_vector / 2 * (half.sin() / half)], dim=-1)


def logarithm(q: Float[Tensor, "*batch 4"]) -> Float[Tensor, "*batch 3"]:
    """Rotation vectors [rad] of unit quaternions, with an angle of at most pi."""
    q = torch.where(q[..., :1] < 0, -q, q)
    sine = q[..., 1:].norm(dim=-1, keepdim=True)
    angle = 2 * torch.atan2(sine, q[..., :1])
    return q[..., 1:] * torch.where(sine > 1e-7, angle / sine.clamp(min=1e-7), 2.0)


def matrix(q: Float[Tensor, "*batch 4"]) -> Float[Tensor, "*batch 3 3"]:
    """Rotation matrices of unit quaternions."""
    w, x, y, z = q.unbind(-1)
    rows = [
        *(1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)),
        *(2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)),
        *(2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)),
    ]
    return torch.stack(rows, dim=-1).unflatten(-1, (3, 3))


def rotate(q: Float[Tensor, "*batch 4"], v: Float[Tensor, "*batch 3"]) -> Float[Tensor, "*batch 3"]:
    """Rotate vectors by unit quaternions."""
    u = q[..., 1:]
    t = 2 * torch.linalg.cross(u, v)
    return v + q[..., :1] * t + torch.linalg.cross(u, t)


def facing(direction: Float[Tensor, "A 2"]) -> Float[Tensor, "A 3 3"]:
    """Rotation matrices about the vertical that take a horizontal unit vector to +x."""
    x, y = direction.unbind(1)
    zero, one = torch.zeros_like(x), torch.ones_like(x)
    return torch.stack([x, y, zero, -y, x, zero, zero, zero, one], dim=1).view(-1, 3, 3)
