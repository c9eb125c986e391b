"""Models of an episode's objects: fields, dynamics, shapes, symmetries."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path

from osfcore.dynamics.dynamics_model import DynamicsModel
from osfcore.dynamics.network_weights import read_network
from osfcore.dynamics.push_models import load_shapes, network_path
from osfcore.dynamics.rollout import PushModel
from osfcore.dynamics.shapes.object_shapes import ObjectShape
from osfcore.estimation.objective.object_models import ObjectModels
from osfcore.fields.field_library import FieldLibrary
from osfcore.objects.asset import Symmetry
from osfcore.objects.asset_library import AssetLibrary


@dataclass(frozen=True, slots=True)
class SceneModels:
    """Models of the objects, loaded before the first image.

    Attributes:
        appearance: how objects and table look.
        dynamics: what pushes do.
        pushes: the network that proposals are drawn by, whatever predicts them.
        shapes: of the objects, by name.
        symmetries: which of their orientations look the same; none for those left out.
    """

    appearance: ObjectModels
    dynamics: DynamicsModel
    pushes: PushModel
    shapes: Mapping[str, ObjectShape]
    symmetries: Mapping[str, Symmetry]


def load_scene_models(
    names: tuple[str, ...], fields: FieldLibrary, assets: AssetLibrary, data_dir: Path | None, device: str = "cpu"
) -> SceneModels:
    """Load the models of some objects.

    Args:
        names: of the objects.
        fields: library of their fields.
        assets: library of their symmetries.
        data_dir: whose weights and convex parts come before the installed ones.
        device: that computes.

    Raises:
        UnknownName: if one has no field.
        CorruptFile: if a file is broken.
    """
    shapes = load_shapes(data_dir, fields, names)
    pushes = PushModel(read_network(network_path(data_dir)), shapes, device)
    symmetries = {name: assets.info(name).symmetry for name in names}
    loaded, table = {name: fields.load(name) for name in names}, fields.load_table()
    appearance = ObjectModels(loaded, table, device=device, symmetries=symmetries)
    return SceneModels(appearance, pushes, pushes, shapes, symmetries)
