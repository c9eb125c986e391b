"""One scene under lights of several elevations, as a method shows it, against the simulator."""

from __future__ import annotations

from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from osfcore.experiments.fields.composite_scenes import compare_scene, figures_of, mean_of, render_scene, simulate_relit
from osfcore.experiments.image_methods import load_appearance
from osfcore.experiments.task_cache import TaskResult
from osfcore.fields.field_library import FieldLibrary
from osfcore.geometry.cameras import default_cameras
from osfcore.geometry.light import Light
from osfcore.objects.asset_library import AssetLibrary
from osfcore.world.random_scenes import Draw

MEASURES = ("psnr", "ssim", "psnr_object", "psnr_shadow")


@dataclass(frozen=True, eq=False, slots=True)
class RelitScenes:
    """Measures single scenes; can be sent to other processes.

    Attributes:
        fields: ours, and the table.
        assets: meshes for the simulator.
        data_dir: where fields of other methods may be.
        elevations_deg: of the lights above the table.
        size: side of the images [px].
    """

    fields: FieldLibrary
    assets: AssetLibrary
    data_dir: Path
    elevations_deg: tuple[float, ...]
    size: int

    def measure(self, draw: Draw, method: str) -> TaskResult:
        """A scene shown by a method that is told its true poses and light.

        Args:
            draw: the scene; its light tells the azimuth of all lights.
            method: one of `osfcore.experiments.image_methods.FIELD_METHODS`.

        Returns:
            For each measure its means over the four cameras, one for each elevation; comparisons of the first camera
            under the lowest, the middle and the highest light.

        Raises:
            NoRoom: if the objects do not fit side by side.
            UnknownName, CorruptFile: as fields are.
        """
        azimuth = float(np.arctan2(draw.light.direction[1], draw.light.direction[0]))
        lights = [Light.from_angles(azimuth, np.deg2rad(elevation)) for elevation in self.elevations_deg]
        truths = simulate_relit(draw, lights, self.assets, default_cameras(self.size))
        renderer = load_appearance(method, draw.names, self.fields, self.data_dir).together
        scenes = [compare_scene(truth, render_scene(renderer, truth)) for truth in truths]
        figures = [figures_of(scene) for scene in scenes]
        return TaskResult(
            {key: [mean_of([one], key) for one in figures] for key in MEASURES},
            tuple(
                replace(scenes[n][0].comparison, label=f"{self.elevations_deg[n]:g} deg")
                for n in sorted({0, len(scenes) // 2, len(scenes) - 1})
            ),
        )
