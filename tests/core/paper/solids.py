"""KiloOSFs as published whose answers are known: networks that ignore where they are asked."""

import numpy as np

from osfcore.paper.fields import TinyField, first_field, layer_shapes

WIDTH, VOXEL = 8, 0.005


def empty_block(shape=(13, 11, 9), *, across: int = 3, seed: int = 0, width: int = WIDTH) -> TinyField:
    """A grid around the origin, occupied but for its outermost corners, with random networks."""
    occupied = np.zeros(shape, bool)
    occupied[1:-1, 1:-1, 1:-1] = True
    origin = (-VOXEL * (np.array(shape) - 1) / 2).astype(np.float32)
    return first_field(origin, VOXEL, occupied, across=across, width=width, most_networks=1000,
                       rng=np.random.default_rng(seed))  # fmt: skip


def uniform_block(rho=(0.8, 0.4, 0.2), sigma: float = 4000.0, **kwargs) -> TinyField:
    """The same, of one density [1/m] and one radiance transfer."""
    field = empty_block(**kwargs)
    parts, at = np.zeros_like(field.networks), 0
    for number, (inputs, outputs) in enumerate(layer_shapes(field.width)):
        biases = slice(at + inputs * outputs, at + (inputs + 1) * outputs)
        if number == 2:
            parts[:, biases.stop - 1] = np.log(np.expm1(sigma / field.density_scale))
        if number == 4:
            parts[:, biases] = np.log(np.array(rho) / (1 - np.array(rho)))
        at = biases.stop
    return TinyField(field.origin, field.voxel, field.occupied, field.cells, parts, field.width)
