"""`osf render`: a picture of a scene file through the fields of its objects."""

from __future__ import annotations

from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Literal

from app.storage.paths import default_data_dir
from osfcore.errors import InvalidInput
from osfcore.io.image_file import to_uint8


@dataclass(frozen=True)
class Render:
    """Render a scene with neural fields: relit, with shadows, without any mesh."""

    scene: Path
    """scene.json with objects, light, pusher and perhaps cameras, or the state.json of an estimate."""
    out: Path
    """PNG to write."""
    camera: str = "0"
    """Name of one of the scene's cameras; of 0 to 3 and goal, the usual ones, if it has none."""
    device: Literal["auto", "cpu", "cuda"] = "auto"
    """What computes; auto takes a GPU where there is one."""
    data_dir: Path = field(default_factory=default_data_dir)
    """Where fields trained on this machine are."""
    json: bool = False
    """Print the result as one JSON object in the last line."""

    def run(self) -> dict[str, Any]:
        """Render with two by two rays a pixel; the result tells the file and its size."""
        from osfcore.fields.devices import pick_device
        from osfcore.fields.field_library import FieldLibrary
        from osfcore.geometry.cameras import default_cameras, goal_camera
        from osfcore.io.image_file import write_png
        from osfcore.io.output_paths import check_place
        from osfcore.io.scene_file import read_scene
        from osfcore.render.renderer import SceneRenderer
        from osfcore.render.types import Quality, SceneBatch

        if self.out.suffix.lower() != ".png":
            raise InvalidInput("output file", self.out, "a path that ends in .png")
        check_place(self.out)
        scene = read_scene(self.scene)
        cameras = {camera.name: camera for camera in scene.cameras or (*default_cameras(), goal_camera())}
        if self.camera not in cameras:
            raise InvalidInput("camera", self.camera, f"one of {', '.join(cameras)}")
        library = FieldLibrary(self.data_dir)
        fields = {name: library.load(name) for name in scene.state.names}
        renderer = SceneRenderer(fields, library.load_table(), device=str(pick_device(self.device)))
        quality = Quality(samples_per_side=2)
        image = renderer.render(SceneBatch.of(scene.state), (cameras[self.camera],), quality=quality).rgb[0, 0]
        pixels = to_uint8(image)
        write_png(self.out, pixels)
        height, width = pixels.shape[:2]
        if not self.json:
            print(f"Wrote {self.out}, {width} x {height} px.")
        return {"out": str(self.out), "width": width, "height": height, "objects": list(scene.state.names)}
