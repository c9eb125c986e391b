"""How a sliding object gives way to a push, by the ellipsoidal limit surface of friction with the table.

Friction force and moment lie on an ellipsoid (Howe and Cutkosky 1996), so that a push through a contact decides the
whole motion, sticking or sliding along the contact (Lynch, Maekawa and Tanie 1992).
"""

from __future__ import annotations

import torch
from jaxtyping import Float
from torch import Tensor

FRICTION = 0.25  # between pusher and object, as in the simulator
_LEVER_SHARE = 1.2  # moment that friction can hold over force, in mean radii of the outline: things stand on corners


def lever(outline: Float[Tensor, "*batch K 2"]) -> Float[Tensor, "*batch"]:
    """Moment over force that friction with the table can hold, from outlines around their centres of mass [m]."""
    return _LEVER_SHARE * outline.norm(dim=-1).mean(dim=-1)


def slide(
    point: Float[Tensor, "B 2"],
    inward: Float[Tensor, "B 2"],
    depth: Float[Tensor, "B"],
    shift: Float[Tensor, "B 2"],
    arm: Float[Tensor, "B"],
) -> Float[Tensor, "B 3"]:
    """How an object gives way at a contact: displacement (x, y) [m] and turn about the vertical [rad].

    Args:
        point: of contact, from the centre of friction [m].
        inward: normal into the object.
        depth: how far the contact must move along the normal [m].
        shift: of what pushes; its tangential part drags the contact along while friction holds [m].
        arm: moment over force that friction with the table can hold [m].
    """
    tangent = torch.stack([-inward[:, 1], inward[:, 0]], dim=1)
    drag = (shift * tangent).sum(dim=1)
    x, y = point.unbind(1)
    wanted = depth[:, None] * inward + drag[:, None] * tangent
    c2 = arm.square()
    vx = (c2 + x * x) * wanted[:, 0] + x * y * wanted[:, 1]
    vy = x * y * wanted[:, 0] + (c2 + y * y) * wanted[:, 1]
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
