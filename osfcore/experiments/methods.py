"""Methods that show scenes where images are compared: which objects each one knows, and how it shows them.

Methods:
    ours   relightable fields as they ship.
    paper  KiloOSFs as published.
    nerf   compositional NeRFs: fields that know of no light.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import asdict
from pathlib import Path
from types import MappingProxyType
from typing import Any

from osfcore.errors import InvalidInput
from osfcore.estimation.objective import ObjectModels
from osfcore.experiments.fields import SCENE_QUALITY
from osfcore.experiments.harness import chosen_objects, file_sha256, table_sha256
from osfcore.experiments.rivals.nerf import load_nerf_appearance, nerf_library
from osfcore.fields.field_library import FieldLibrary
from osfcore.geometry.states import MAX_OBJECTS
from osfcore.objects.asset_library import AssetLibrary
from osfcore.paper.method import paper_field_names, paper_field_path
from osfcore.paper.stages import load_paper_appearance
from osfcore.world.tasks import Draw

OURS = "ours"  # what others are compared with
FIELD_METHODS = (OURS, "paper", "nerf")
TITLES: Mapping[str, str] = MappingProxyType(
    {"copied": "last frame", OURS: "ours", "paper": "as published", "nerf": "NeRF", "fitvid": "FitVid"}
)  # in charts and beside images


def check_methods(methods: Iterable[str], known: Sequence[str]) -> tuple[str, ...]:
    """Return the methods in the order of the known ones, each once.

    Raises:
        InvalidInput: if there is none, or one is not known.
    """
    asked = tuple(methods)
    unknown = [method for method in dict.fromkeys(asked) if method not in known]
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
    """Return the objects with a mesh, a field of ours and one of each method, so that all are given the same scenes.

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
        named = tuple(dict.fromkeys(names))
        for name in named:
            for method in (OURS, *methods):
                field_path(method, name, fields, data_dir)  # raises UnknownName
        chosen = chosen_objects(named, fields, assets)
    if len(chosen) < count:
        what = "number of objects with a mesh and a field of every method"
        raise InvalidInput(what, len(chosen), f"at least {count}, as a scene has")
    return chosen


def known_names(method: str, fields: FieldLibrary, data_dir: Path | None) -> tuple[str, ...]:
    """Return the objects that a method has a field of; ours for methods without fields of their own."""
    match method:
        case "paper":
            return paper_field_names(data_dir)
        case "nerf":
            return nerf_library(data_dir).names()
        case _:
            return fields.names()


def field_path(method: str, name: str, fields: FieldLibrary, data_dir: Path | None) -> Path:
    """Return the file of a method's field of an object; ours for methods without fields of their own.

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
    """Load a method's fields of objects and of the table.

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


def shown_circumstances(
    draw: Draw, methods: Sequence[str], fields: FieldLibrary, assets: AssetLibrary, data_dir: Path | None, size: int
) -> dict[str, Any]:
    """Return what the images of a scene depend on, as plain JSON.

    Args:
        draw: the scene.
        methods: whose fields of its objects are used.
        fields: ours, and the table.
        assets: meshes of the objects.
        data_dir: whose fields of other methods come before the installed ones.
        size: side of the images [px].

    Raises:
        UnknownName, MissingAssets, CorruptFile: if a field or a mesh cannot be read.
    """
    paths = {name: [field_path(method, name, fields, data_dir) for method in methods] for name in draw.names}
    return {
        "objects": {name: [assets.digest(name), *map(file_sha256, own)] for name, own in paths.items()},
        "arrangement": draw.seed,
        "light": draw.light.direction.tolist(),
        "size": size,
        "quality": asdict(SCENE_QUALITY),
        "table": table_sha256(fields.load_table()),
    }
