"""`osf import`: data of others as what is estimated from here."""

from __future__ import annotations

from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Literal

import tyro

from app.storage.paths import default_data_dir
from osfcore.errors import InvalidInput

POSES_FILE = "poses.json"


@dataclass(frozen=True)
class Import:
    """A scene of a BOP data set with YCB-V's objects as an observation folder, for 'osf estimate'."""

    kind: tyro.conf.Positional[Literal["bop"]]
    """What is imported."""
    scene: tyro.conf.Positional[Path]
    """Folder of the scene: scene_camera.json, scene_gt.json, rgb, mask_visib."""
    out: Path
    """Folder to write; must be new or empty. poses.json in it tells the annotated poses in the world."""
    images: tuple[int, ...] | None = None
    """Numbers of the images; by default all, or 32 spread over them."""
    names: tuple[str, ...] | None = None
    """Objects to keep; by default all that have a field, of which there may be 8."""
    table: Literal["world", "objects"] = "world"
    """Where the table is: BOP's world is its frame (z up, table at z = 0), or where most objects would stand."""
    encoding: Literal["srgb", "linear"] = "srgb"
    """What values of the pictures mean: sRGB, as cameras write; linear radiance, as in renderings from here."""
    models: Path | None = None
    """Folder with models_info.json, where the models are not those of BOP's YCB-V, which are centred."""
    data_dir: Path = field(default_factory=default_data_dir)
    """Where fields trained on this machine are."""
    json: bool = False
    """Print the result as one JSON object in the last line."""

    def run(self) -> dict[str, Any]:
        """Import; the result tells images and objects, and which objects were left out."""
        from osfcore.contrib.bop import BopChoice, read_bop_scene
        from osfcore.fields.field_library import FieldLibrary
        from osfcore.io.files import folder_at_once, write_json
        from osfcore.io.observation_file import write_observation

        out = self.out.absolute()
        if out.exists() and (not out.is_dir() or any(out.iterdir())):
            raise InvalidInput("output folder", self.out, "new or empty")
        choice = BopChoice(self.images, self.encoding, self.models)
        prior = self._prior if self.table == "objects" else None
        known = FieldLibrary(self.data_dir).names()
        scene = read_bop_scene(self.scene, choice, self.names, prior, known)
        poses = {
            name: {"position": pose.position.tolist(), "quaternion": pose.quaternion.tolist()}
            for name, pose in scene.poses.items()
        }
        with folder_at_once(out) as partial:
            write_json(partial / POSES_FILE, poses)
            write_observation(partial, scene.observation)
        images = [camera.name for camera in scene.observation.cameras]
        names = list(scene.observation.names)
        if not self.json:
            print(f"Wrote {self.out}: images {', '.join(images)} of {', '.join(names)}.")
            if self.names is None and scene.left_out:
                print(f"Left out, as there are no fields of them: {', '.join(scene.left_out)}.")
        left_out = list(scene.left_out)
        return {"out": str(self.out), "images": [int(i) for i in images], "objects": names, "left_out": left_out}

    def _prior(self, name: str) -> Any:  # noqa: ANN401  TablePrior, which the start of the command line must not load
        from osfcore.estimation.objective import resting_orientations
        from osfcore.fields.field_library import FieldLibrary
        from osfcore.photo.pose_loss import TablePrior

        return TablePrior(resting_orientations(FieldLibrary(self.data_dir).load(name)))
