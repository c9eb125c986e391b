"""Quasi-static pushing by the ellipsoidal limit surface of friction with the table.

Friction force (f_x, f_y) and moment m of a sliding object satisfy f_x^2 + f_y^2 + (m / c)^2 = f_max^2 (Howe and
Cutkosky, 1996), c being the moment over force that friction can hold; its velocity is normal to that surface, (v_x,
v_y, w) proportional to (f_x, f_y, m / c^2). A contact at (x, y) that sticks and moves by (u_x, u_y) therefore moves the
object by

    v_x = ((c^2 + x^2) u_x + x y u_y) / (c^2 + x^2 + y^2)
    v_y = (x y u_x + (c^2 + y^2) u_y) / (c^2 + x^2 + y^2)
    w   = (x v_y - y v_x) / c^2

(Lynch, Maekawa and Tanie, 1992). If the force lies outside the friction cone, the contact slides, and the force is that
edge of the cone.
"""

from __future__ import annotations

import torch
from jaxtyping import Float
from torch import Tensor

FRICTION = 0.25  # between pusher and object, as in the simulator
ARM_RATIO = 1.2  # c over the mean radius of the outline: objects stand on their corners


def friction_arm(outline: Float[Tensor, "*batch K 2"]) -> Float[Tensor, "*batch"]:
    """c: moment over force that friction with the table can hold, from outlines around their centres of mass [m]."""
    return ARM_RATIO * outline.norm(dim=-1).mean(dim=-1)


def push_motion(
    point: Float[Tensor, "B 2"],
    inward: Float[Tensor, "B 2"],
    depth: Float[Tensor, "B"],
    shift: Float[Tensor, "B 2"],
    arm: Float[Tensor, "B"],
) -> Float[Tensor, "B 3"]:
    """Motion of an object pushed at a contact: displacement (x, y) [m] and rotation about the vertical [rad].

    Args:
        point: of contact, from the centre of friction [m].
        inward: normal into the object.
        depth: how far the contact must move along the normal [m].
        shift: of what pushes; its tangential part drags the contact along while friction holds [m].
        arm: c, moment over force that friction with the table can hold [m].

    Returns:
        (v_x, v_y, w), zero where depth is not positive.
    """
    tangent = torch.stack([-inward[:, 1], inward[:, 0]], dim=1)
    drag = (shift * tangent).sum(dim=1)
    x, y = point.unbind(1)
    velocity = depth[:, None] * inward + drag[:, None] * tangent
    c2 = arm.square()
    vx = (c2 + x * x) * velocity[:, 0] + x * y * velocity[:, 1]
    vy = x * y * velocity[:, 0] + (c2 + y * y) * velocity[:, 1]
    sticking = torch.stack([vx, vy, x * vy / c2 - y * vx / c2], dim=1) / (c2 + x * x + y * y)[:, None]
    force = sticking[:, :2]
    normal, side = (force * inward).sum(dim=1), (force * tangent).sum(dim=1)
    holds = side.abs() <= FRICTION * normal
    edge = inward + FRICTION * side.sign()[:, None] * tangent
    turn = (x * edge[:, 1] - y * edge[:, 0]) / c2
    contact = edge + turn[:, None] * torch.stack([-y, x], dim=1)
    gain = depth / (contact * inward).sum(dim=1).clamp(min=1e-3)
    sliding = gain[:, None] * torch.cat([edge, turn[:, None]], dim=1)
    return torch.where(holds[:, None], sticking, sliding) * (depth > 0)[:, None]
