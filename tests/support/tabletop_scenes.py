"""A box and a can on the table, and what is known of them."""

import numpy as np

from osfcore.control.estimators import SceneModels
from osfcore.dynamics.rollout import load_push_model, load_shapes
from osfcore.estimation.objective import ObjectModels
from osfcore.estimation.uncertainty import FitQuality
from osfcore.fields.field_library import FieldLibrary
from osfcore.geometry.light import Light
from osfcore.geometry.states import EstimatedState, SceneState
from osfcore.objects.asset import Symmetry
from osfcore.world.scenes import SceneRequest
from osfcore.world.tabletop import Tabletop

GELATIN, CAN = NAMES = ("009_gelatin_box", "005_tomato_soup_can")
LIGHT = Light.from_angles(0.8, 0.7)


def models() -> SceneModels:
    """Of both objects."""
    fields = FieldLibrary(None)
    appearance = ObjectModels({name: fields.load(name) for name in NAMES}, fields.load_table())
    dynamics, shapes = load_push_model(None, fields, NAMES), load_shapes(None, fields, NAMES)
    return SceneModels(appearance, dynamics, dynamics, shapes, {name: Symmetry("none") for name in NAMES})


def table(library) -> Tabletop:
    """A world with both objects at rest, far enough from each other."""
    world = Tabletop(library, request=SceneRequest(names=NAMES, light=LIGHT))
    world.arrange(2)
    return world


def sure(state: SceneState, doubts: tuple[str, ...] | None = None) -> EstimatedState:
    """An estimate without errors, perhaps doubted."""
    count = len(state.names)
    doubts = ("",) * count if doubts is None else doubts
    reason = "; ".join(f"{n}: {d}" for n, d in zip(state.names, doubts, strict=True) if d)
    return EstimatedState(state, np.full(count, 1e-3), np.full(count, 1e-2), 1e-2, doubts, reason)


def perfect_fit(count: int) -> FitQuality:
    """Images that show objects just as they are rendered."""
    each = np.ones(count)
    return FitQuality(np.zeros((1, count)), 100 * each[None], 0.1 * each, 0.3 * each, each, 0.0, 0.0)
