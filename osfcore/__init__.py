"""Object-centric neural scattering functions for multi-object manipulation: the core, free of user interfaces.

A map of the rooms, each importing only from those above it:

    geometry     poses, rotations, cameras, light, scene states, rollouts, convex parts
    io           file formats with their checks: scenes, states, observations, image sets, pushes, rollouts
    objects      the catalogue of objects, their meshes, and the library on disk
    metrics      errors of poses and images, success of rearrangements
    fields       neural scattering functions (OSF, KiloOSF), the table's field, and their training
    render       volume rendering of many fields on the table: a reference and a fast path
    estimation   images to poses and light: CMA-ES, light search, Gauss-Newton, template matching
    photo        real photographs: reading them, board, masks, poses and lamp
    dynamics     what a push does: contact graph and propagation network
    planning     MPPI, costs, push primitives, path planning
    control      Algorithm 1 of the paper as a generator of events over a `World`
    paper        the paper's dynamics model as published, to compare ours with
    world        the simulated tabletop (PyBullet or MuJoCo) and data collection
    contrib      beyond the paper: files of others, robots, a Gymnasium environment, a client of the service
    inspection   checks of files, and pictures of how they were understood
    experiments  evaluations and benchmarks; only the command line imports it

Letters of array shapes: V views, N objects, h w pixels, R rays, S samples a ray, K action sequences, T planning steps,
B scenes of a batch.

Conventions: SI units; z up, the table top is z = 0; unit quaternions (w, x, y, z); `T_a_b` maps coordinates in b to
coordinates in a; OpenCV cameras; images are linear RGB in [0, 1].

The public names stand in `__init__.pyi` and are loaded when they are first used: `import osfcore` alone loads nothing
heavy.
"""

from typing import Any

import lazy_loader

_load, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)


def __getattr__(name: str) -> Any:  # noqa: ANN401  whatever the name stands for
    """Import a public name from its room when it is first used."""
    if name not in __all__:
        raise AttributeError(f"module 'osfcore' has no attribute {name!r}; it has {', '.join(sorted(__all__))}")
    return _load(name)
