"""`osf export`: scenes and fields as files that other programs open."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import tyro

from app.cli.commands.exchange.export_poses import ExportPoses
from app.storage.paths import default_data_dir
from osfcore.errors import InvalidInput

if TYPE_CHECKING:
    from osfcore.fields.kiloosf import KiloOSF
    from osfcore.geometry.light import Light


@dataclass(frozen=True)
class ExportScene:
    """A scene as GLB or USDZ for Blender, game engines and browsers: objects, table, pusher, cameras, and the light."""

    scene: Path
    """scene.json, or the state.json of an estimate."""
    out: Path
    """.glb or .usdz to write."""
    fields: bool = False
    """Objects as the surfaces of their fields, also where this machine has their meshes."""
    data_dir: Path = field(default_factory=default_data_dir)
    """Where fetched objects, and fields trained on this machine, are."""
    json: bool = False
    """Print the result as one JSON object in the last line."""

    def run(self) -> dict[str, Any]:
        """Export; the result tells which objects are meshes and which are surfaces of fields."""
        from osfcore.fields.field_library import FieldLibrary
        from osfcore.io.scene_file import read_scene
        from osfcore.objects.asset_library import AssetLibrary

        suffix = _check_out(self.out, ".glb", ".usdz")
        if suffix == ".glb":
            from osfcore.contrib.export.meshes import scene_glb as export
        else:
            from osfcore.contrib.export.usd import scene_usdz as export
        scene = read_scene(self.scene)
        library, fields = AssetLibrary(self.data_dir / "objects"), FieldLibrary(self.data_dir)
        scanned = [name for name in scene.state.names if library.has(name) and not self.fields]
        shapes = {n: library.load(n).mesh if n in scanned else fields.load(n) for n in scene.state.names}
        size = _write(self.out, lambda: export(scene, shapes, fields.load_table()))
        others = [name for name in scene.state.names if name not in scanned]
        if not self.json:
            x, y, z = scene.state.light.direction
            print(f"Wrote {self.out}, {size / 1e6:.1f} MB; light toward ({x:.3f}, {y:.3f}, {z:.3f}).")
            if others:
                print(f"Surfaces of fields, with their albedo: {', '.join(others)}.")
        return {"out": str(self.out), "bytes": size, "meshes": scanned, "fields": others}


@dataclass(frozen=True)
class ExportField:
    """The surface of a field as GLB or USD, with a colour for each vertex."""

    name: tyro.conf.Positional[str]
    """Name of an object that has a field, such as 006_mustard_bottle, or a .safetensors file."""
    out: Path
    """.glb, .usdz or .usdc to write."""
    light: tuple[float, float, float] | None = None
    """Direction toward a light whose shading is baked into the colours; without it they are the albedo."""
    data_dir: Path = field(default_factory=default_data_dir)
    """Where fields trained on this machine are."""
    json: bool = False
    """Print the result as one JSON object in the last line."""

    def run(self) -> dict[str, Any]:
        """Export; the result tells what the colours are."""
        suffix = _check_out(self.out, ".glb", ".usdz", ".usdc")
        if suffix == ".glb":
            from osfcore.contrib.export.meshes import field_glb as export
        else:
            from osfcore.contrib.export.usd import field_usd

            export = partial(field_usd, is_packed=suffix == ".usdz")
        light, shape = None if self.light is None else _light(self.light), _field(self.name, self.data_dir)
        size = _write(self.out, lambda: export(shape, Path(self.name).stem, light))
        if not self.json:
            colours = "the albedo" if light is None else f"those under the light toward {self.light}, baked in"
            print(f"Wrote {self.out}, {size / 1e6:.1f} MB; its colours are {colours}.")
        return {"out": str(self.out), "bytes": size, "colours": "albedo" if light is None else "baked"}


@dataclass(frozen=True)
class ExportSplats:
    """A field as 3D Gaussian splats (PLY). The lighting is baked in: splats cannot be lit anew."""

    name: tyro.conf.Positional[str]
    """Name of an object that has a field, such as 006_mustard_bottle, or a .safetensors file."""
    out: Path
    """PLY to write."""
    light: tuple[float, float, float] = (0.0, 0.0, 1.0)
    """Direction toward the light that is baked in, in the object's frame; from straight above by default."""
    data_dir: Path = field(default_factory=default_data_dir)
    """Where fields trained on this machine are."""
    json: bool = False
    """Print the result as one JSON object in the last line."""

    def run(self) -> dict[str, Any]:
        """Export; the result tells how many Gaussians there are."""
        from osfcore.contrib.export.splats import field_splats, splats_ply

        _check_out(self.out, ".ply")
        splats = field_splats(_field(self.name, self.data_dir), _light(self.light))
        size, count = _write(self.out, lambda: splats_ply(splats)), len(splats.means)
        if not self.json:
            print(f"Wrote {self.out}, {count} Gaussians; lighting baked in, light toward {self.light}.")
        return {"out": str(self.out), "bytes": size, "splats": count, "light": splats.light.direction.tolist()}


def _check_out(out: Path, *suffixes: str) -> str:
    """Refuse what cannot be written before the work begins; which of the suffixes it is."""
    from osfcore.io.output_paths import check_place

    suffix = out.suffix.lower()
    if suffix not in suffixes:
        raise InvalidInput("output file", out, f"a path that ends in {' or '.join(suffixes)}")
    check_place(out)
    return suffix


def _light(direction: tuple[float, float, float]) -> Light:
    import numpy as np

    from osfcore.geometry.light import Light

    return Light(np.array(direction))


def _field(name: str, data_dir: Path) -> KiloOSF:
    from osfcore.fields.field_library import FieldLibrary
    from osfcore.fields.kiloosf import read_field

    return read_field(Path(name)) if name.endswith(".safetensors") else FieldLibrary(data_dir).load(name)


def _write(out: Path, made: Callable[[], bytes]) -> int:
    from osfcore.io.files import write_atomically

    data = made()
    write_atomically(out, data)
    return len(data)


Export = Annotated[
    Annotated[ExportScene, tyro.conf.subcommand("scene")]
    | Annotated[ExportField, tyro.conf.subcommand("field")]
    | Annotated[ExportSplats, tyro.conf.subcommand("splats")]
    | Annotated[ExportPoses, tyro.conf.subcommand("bop")],
    tyro.conf.OmitSubcommandPrefixes,
]
