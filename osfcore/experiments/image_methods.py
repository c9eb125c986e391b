"""Who shows scenes where images are compared: which objects each method knows, and how it shows them.

Methods:
    ours   relightable fields as they ship.
    paper  KiloOSFs as published.
    nerf   compositional NeRFs: fields that know of no light.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path
from types import MappingProxyType

from osfcore.errors import InvalidInput, MissingAssets
from osfcore.estimation.objective.object_models import ObjectModels
from osfcore.experiments.rivals.nerf import load_nerf_appearance, nerf_library
from osfcore.fields.field_library import FieldLibrary
from osfcore.geometry.states import MAX_OBJECTS
from osfcore.objects.asset_library import AssetLibrary
from osfcore.paper.method import paper_field_names, paper_field_path
from osfcore.paper.stages import load_paper_appearance

FIELD_METHODS = ("ours", "paper", "nerf")
TITLES: Mapping[str, str] = MappingProxyType(
    {"copied": "last frame", "ours": "ours", "paper": "as published", "nerf": "NeRF", "fitvid": "FitVid"}
)  # in charts and beside images


def check_methods(methods: Iterable[str], known: Sequence[str]) -> tuple[str, ...]:
    """The methods in the order of the known ones, each once.

    Raises:
        InvalidInput: if there is none, or one is not known.
    """
    asked = tuple(dict.fromkeys(methods))
    unknown = [method for method in asked if method not in known]
    if unknown or not asked:
        raise InvalidInput("methods", ", ".join(unknown) or "none", f"some of {', '.join(known)}")
    return tuple(method for method in known if method in asked)


def common_names(
    methods: Sequence[str],
    names: Iterable[str] | None,
    fields: FieldLibrary,
    assets: AssetLibrary,
    data_dir: Path | None,
    count: int,
) -> tuple[str, ...]:
    """Objects with a mesh, a field of ours and one of each method, so that all methods are given the same scenes.

    Args:
        methods: to compare; those without fields know all objects.
        names: objects to draw from; all that can be compared if None.
        fields: ours.
        assets: meshes, for the simulator.
        data_dir: whose fields of other methods come before the installed ones.
        count: objects of a scene.

    Raises:
        UnknownName, MissingAssets: if an object that is named lacks a field or a mesh.
        InvalidInput: if there are too few, or no scene has so many objects.
    """
    if not 1 <= count <= MAX_OBJECTS:
        raise InvalidInput("objects in a scene", count, f"between 1 and {MAX_OBJECTS}")
    if names is None:
        known = set(fields.names()).intersection(*(known_names(method, fields, data_dir) for method in methods))
        chosen = tuple(name for name in sorted(known) if assets.has(name))
    else:
        chosen = tuple(dict.fromkeys(names))
        for name in chosen:
            for method in ("ours", *methods):
                field_path(method, name, fields, data_dir)
            if not assets.has(name):
                raise MissingAssets([name])
    if len(chosen) < count:
        what = "number of objects with a mesh and a field of every method"
        raise InvalidInput(what, len(chosen), f"at least {count}, as a scene has")
    return chosen


def known_names(method: str, fields: FieldLibrary, data_dir: Path | None) -> tuple[str, ...]:
    """Objects that a method has a field of; ours for methods that have no own ones."""
    match method:
        case "paper":
            return paper_field_names(data_dir)
        case "nerf":
            return nerf_library(data_dir).names()
        case _:
            return fields.names()


def field_path(method: str, name: str, fields: FieldLibrary, data_dir: Path | None) -> Path:
    """Where a method's field of an object lies; ours for methods that have no own ones.

    Raises:
        UnknownName: if there is none.
    """
    match method:
        case "paper":
            return paper_field_path(name, data_dir)
        case "nerf":
            return nerf_library(data_dir).info(name).path
        case _:
            return fields.info(name).path


def load_appearance(method: str, names: Iterable[str], fields: FieldLibrary, data_dir: Path | None) -> ObjectModels:
    """How a method shows objects on the table.

    Args:
        method: one of `FIELD_METHODS`.
        names: of the objects.
        fields: ours, and the table.
        data_dir: whose fields come before the installed ones.

    Raises:
        UnknownName: if an object has no such field.
        CorruptFile: if a file is broken.
    """
    match method:
        case "paper":
            return load_paper_appearance(names, fields, data_dir)
        case "nerf":
            return load_nerf_appearance(names, fields, data_dir)
        case _:
            return ObjectModels({name: fields.load(name) for name in names}, fields.load_table())
