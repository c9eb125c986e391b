"""`osf export`, `osf import` and `osf check`: files for other programs, data of others, and checks of files."""

from __future__ import annotations

import contextlib
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal

import numpy as np
import tyro

from osfcore.errors import CorruptFile, InvalidInput, OsfError
from osfcore.geometry.light import Light
from osfcore.io.files import folder_at_once, write_atomically, write_json

from .command import Command, DataCommand, check_out, choice_of

if TYPE_CHECKING:
    from osfcore.fields.field_library import FieldLibrary
    from osfcore.fields.kiloosf import KiloOSF

POSES_FILE = "poses.json"


@dataclass(frozen=True)
class ExportScene(DataCommand):
    """A scene as GLB or USDZ for Blender, game engines and browsers: objects, table, pusher, cameras, and the light."""

    scene: Path
    """scene.json, or the state.json of an estimate."""
    out: Path
    """.glb or .usdz to write."""
    fields: bool = False
    """Objects as the surfaces of their fields, also where this machine has their meshes."""
    light: bool = True
    """The light of the scene; AR Quick Look on Apple's devices takes none, so that it needs --no-light."""

    def run(self) -> dict[str, Any]:
        """Export; the result lists the objects that are meshes, and those that are surfaces of fields."""
        from osfcore.io.scene_file import read_scene

        suffix = check_out(self.out, ".glb", ".usdz")
        if suffix == ".glb":
            from osfcore.contrib.export.meshes import scene_glb as export
        else:
            from osfcore.contrib.export.usd import scene_usdz as export
        scene = read_scene(self.scene)
        library, fields = self.assets, self.trained
        scanned = [name for name in scene.state.names if library.has(name) and not self.fields]
        shapes = {n: library.load(n).mesh if n in scanned else fields.load(n) for n in scene.state.names}
        data = export(scene, shapes, fields.load_table(), has_light=self.light)
        write_atomically(self.out, data)
        others = [name for name in scene.state.names if name not in scanned]
        x, y, z = scene.state.light.direction
        light = f"light toward ({x:.3f}, {y:.3f}, {z:.3f})" if self.light else "without light"
        self.say(f"Wrote {self.out}, {len(data) / 1e6:.1f} MB; {light}.")
        if others:
            self.say(f"Surfaces of fields, with their albedo: {', '.join(others)}.")
        return {"out": str(self.out), "bytes": len(data), "meshes": scanned, "fields": others}


@dataclass(frozen=True)
class ExportField(DataCommand):
    """The surface of a field as GLB or USD, with a colour for each vertex."""

    name: tyro.conf.Positional[str]
    """Name of an object that has a field, such as 006_mustard_bottle, or a .safetensors file."""
    out: Path
    """.glb, .usdz or .usdc to write."""
    light: tuple[float, float, float] | None = None
    """Direction toward a light whose shading is baked into the colours; without it they are the albedo."""

    def run(self) -> dict[str, Any]:
        """Export; the result has the kind of colours."""
        suffix = check_out(self.out, ".glb", ".usdz", ".usdc")
        if suffix == ".glb":
            from osfcore.contrib.export.meshes import field_glb as export
        else:
            from osfcore.contrib.export.usd import field_usd

            export = partial(field_usd, is_packed=suffix == ".usdz")
        light = None if self.light is None else Light(np.array(self.light))
        data = export(_field(self.name, self.trained), Path(self.name).stem, light)
        write_atomically(self.out, data)
        colours = "the albedo" if light is None else f"those under the light toward {self.light}, baked in"
        self.say(f"Wrote {self.out}, {len(data) / 1e6:.1f} MB; its colours are {colours}.")
        return {"out": str(self.out), "bytes": len(data), "colours": "albedo" if light is None else "baked"}


@dataclass(frozen=True)
class ExportSplats(DataCommand):
    """A field as 3D Gaussian splats (PLY). The lighting is baked in: splats cannot be lit anew."""

    name: tyro.conf.Positional[str]
    """Name of an object that has a field, such as 006_mustard_bottle, or a .safetensors file."""
    out: Path
    """PLY to write."""
    light: tuple[float, float, float] = (0.0, 0.0, 1.0)
    """Direction toward the light that is baked in, in the object's frame; from straight above by default."""

    def run(self) -> dict[str, Any]:
        """Export; the result has the number of Gaussians."""
        from osfcore.contrib.export.splats import field_splats, splats_ply

        check_out(self.out, ".ply")
        splats = field_splats(_field(self.name, self.trained), Light(np.array(self.light)))
        data, count = splats_ply(splats), len(splats.means)
        write_atomically(self.out, data)
        self.say(f"Wrote {self.out}, {count} Gaussians; lighting baked in, light toward {self.light}.")
        return {"out": str(self.out), "bytes": len(data), "splats": count, "light": splats.light.direction.tolist()}


def _field(name: str, library: FieldLibrary) -> KiloOSF:
    from osfcore.fields.kiloosf import read_field

    return read_field(Path(name)) if name.endswith(".safetensors") else library.load(name)


@dataclass(frozen=True)
class ExportPoses(Command):
    """Estimated poses as the CSV that BOP's toolkit evaluates: every object in every image of a scene."""

    state: Path
    """state.json of the estimate."""
    observation: Path
    """Folder that 'osf import bop' wrote: its cameras are the images of the scene."""
    scene: int
    """Number of the scene in BOP's data set."""
    out: Path
    """CSV to write."""
    models: Path | None = None
    """Folder with models_info.json, where the models are not those of BOP's YCB-V, which are centred."""
    seconds: float = -1.0
    """Time that the estimation took [s]; -1 if it is not known."""

    def run(self) -> dict[str, Any]:
        """Export; the result has the number of poses."""
        from osfcore.contrib.bop import bop_results
        from osfcore.io.observation_file import read_observation
        from osfcore.io.scene_file import read_estimated

        check_out(self.out, ".csv")
        estimate, cameras = read_estimated(self.state), read_observation(self.observation).cameras
        write_atomically(self.out, bop_results(estimate, cameras, self.scene, self.models, self.seconds).encode())
        count = len(cameras) * len(estimate.state.names)
        self.say(f"Wrote {self.out}: {count} poses in {len(cameras)} images of scene {self.scene}.")
        return {"out": str(self.out), "scene": self.scene, "images": len(cameras), "poses": count}


Export = choice_of(scene=ExportScene, field=ExportField, splats=ExportSplats, bop=ExportPoses)


@dataclass(frozen=True)
class Import(DataCommand):
    """A scene in BOP's layout as an observation folder, for 'osf estimate'."""

    kind: tyro.conf.Positional[Literal["bop"]]
    """What is imported."""
    scene: tyro.conf.Positional[Path]
    """Folder of the scene: scene_camera.json, scene_gt.json, rgb, mask_visib."""
    out: Path
    """Folder to write; must be new or empty. poses.json in it has the annotated poses in the world."""
    images: tuple[int, ...] | None = None
    """Numbers of the images; by default all, or 32 spread over them."""
    names: tuple[str, ...] | None = None
    """Objects to keep; by default all that have a field, of which there may be 8."""
    table: Literal["world", "objects"] = "world"
    """Where the table is: BOP's world is its frame (z up, table at z = 0), or where most objects would stand."""
    encoding: Literal["srgb", "linear"] = "srgb"
    """What values of the pictures mean: sRGB, as cameras write; linear radiance, as in renderings from here."""
    models: Path | None = None
    """Folder with models_info.json; by default that of the data set, or BOP's YCB-V if it has none."""

    def run(self) -> dict[str, Any]:
        """Import; the result lists images, objects, and objects left out."""
        from osfcore.contrib.bop import BopChoice, read_bop_scene
        from osfcore.io.observation_file import write_observation

        out = self.out.absolute()
        if out.exists() and (not out.is_dir() or any(out.iterdir())):
            raise InvalidInput("output folder", self.out, "new or empty")
        choice = BopChoice(self.images, self.encoding, self.models)
        prior = self._prior if self.table == "objects" else None
        scene = read_bop_scene(self.scene, choice, self.names, prior, self.trained.names())
        poses = {
            name: {"position": pose.position.tolist(), "quaternion": pose.quaternion.tolist()}
            for name, pose in scene.poses.items()
        }
        with folder_at_once(out) as partial:
            write_json(partial / POSES_FILE, poses)
            write_observation(partial, scene.observation)
        images = [camera.name for camera in scene.observation.cameras]
        names = list(scene.observation.names)
        self.say(f"Wrote {self.out}: images {', '.join(images)} of {', '.join(names)}.")
        self.say(*scene.notes, *(f"Left out: {name}, {why}." for name, why in scene.left_out.items()))
        result = {"out": str(self.out), "images": [int(i) for i in images], "objects": names}
        return {**result, "left_out": list(scene.left_out), "notes": list(scene.notes)}

    def _prior(self, name: str) -> Any:  # noqa: ANN401  TablePrior, which the start of the command line must not load
        from osfcore.estimation.objective import resting_orientations
        from osfcore.photo.pose_loss import TablePrior

        return TablePrior(resting_orientations(self.trained.load(name)))


@dataclass(frozen=True)
class Check(Command):
    """Validate a scene, state, push file, field, results of BOP, or a folder: observation, image set, scene of BOP."""

    path: tyro.conf.Positional[Path]
    """File or folder to check; an image set may be zipped."""
    overlay: Path | None = None
    """For an image set: PNG to write, with axes, light and the silhouettes' box drawn into some of its images; for an
    observation with axes, workspace and masks; for a scene of BOP with masks and the annotated objects' axes."""

    def run(self) -> dict[str, Any]:
        """Check; the result has the kind of file and how much is in it."""
        from osfcore.inspection.check import check_overlay_place, check_path, draw_overlay

        if self.overlay is not None:
            check_overlay_place(self.overlay)
        if not self.path.exists():
            raise CorruptFile(self.path, "there is no such file or folder")
        try:
            report = check_path(self.path)
        except CorruptFile:
            if self.overlay is not None:
                # What contradicts itself is best seen; what cannot even be drawn is in the error.
                with contextlib.suppress(OsfError):
                    draw_overlay(self.path, self.overlay)
                    self.say(f"{self.overlay} shows how cameras, light and silhouettes were understood.")
            raise
        if self.overlay is not None:
            draw_overlay(self.path, self.overlay)
        self.say(f"{self.path} is a good {report.kind}: {report.summary}.", *report.facts.get("notes", ()))
        return {"path": str(self.path), "kind": report.kind, **report.facts}
