"""Compile the kernels before tests begin, so that no test waits for it: on a fresh clone it takes a minute.

What is compiled is kept in .cache. Processes that share the tests begin with different kernels.
"""

from pathlib import Path

import numpy as np
from filelock import FileLock


def compile_kernels(locks: Path, first: int = 0) -> None:
    """Run each kernel once, beginning with the given one; wait for one that another process compiles."""
    kernels = (_render, _roll_out)
    for kernel in kernels[:: -1 if first % 2 else 1]:
        with FileLock(locks / f"{kernel.__name__}.lock"):
            kernel()


def _render() -> None:
    from osfcore.geometry.light import SpotLamp  # what the library imports is checked by a hook that is set by then
    from osfcore.render.renderer import SceneRenderer
    from osfcore.render.types import OUTPUTS, SceneBatch
    from tests.support.rendered_scenes import random_scene, view, wooden_table

    fields, scene = random_scene(9)
    renderer = SceneRenderer(fields, wooden_table())
    for spot in (None, SpotLamp(np.array([0.25, -0.15, 0.45]), np.zeros(3), 25, 40)):
        renderer.render(SceneBatch.of(scene, spot), [view((0.45, 0.1, 0.35), size=16, fov_y_deg=40)], outputs=OUTPUTS)


def _roll_out() -> None:
    from osfcore.dynamics.rollout import PushModel, load_shapes
    from osfcore.fields.field_library import FieldLibrary
    from tests.core.dynamics.scenes import NAMES, crowd, network

    shapes = load_shapes(None, FieldLibrary(None), NAMES)
    PushModel(network(), shapes).rollout(crowd(shapes), np.full((1, 1, 3), [0.3, 0.0, 0.0]))
