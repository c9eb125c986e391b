"""Fields of bodies that are not convex, made by formula."""

import numpy as np

from osfcore.fields.kiloosf import KiloOSF
from osfcore.render.reference import solid_field

VOXEL = 0.004
ARM = np.array([0.05, 0.015, 0.02])


def bracket() -> KiloOSF:
    """Two arms along +x and +y, 10 cm long and 3 cm wide, that share an end at (-3.5, -3.5) cm."""

    def depth(x):
        arms = [
            (ARM - np.abs(x + [0, 0.035, 0])).min(axis=-1),
            (ARM[[1, 0, 2]] - np.abs(x + [0.035, 0, 0])).min(axis=-1),
        ]
        return np.maximum(*arms)

    def normal(x):
        return np.broadcast_to([0.0, 0, 1], x.shape)

    return solid_field(depth, normal, np.full(3, 0.05), (0.5, 0.5, 0.5), voxel=VOXEL, hidden=8)
