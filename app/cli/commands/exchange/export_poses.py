"""`osf export bop`: estimated poses as a results file of BOP."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Any

from osfcore.errors import InvalidInput


@dataclass(frozen=True)
class ExportPoses:
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
    json: bool = False
    """Print the result as one JSON object in the last line."""

    def run(self) -> dict[str, Any]:
        """Export; the result tells how many poses there are."""
        from osfcore.contrib.bop import bop_results
        from osfcore.io.files import write_atomically
        from osfcore.io.observation_file import read_observation
        from osfcore.io.output_paths import check_place
        from osfcore.io.scene_file import read_estimated

        if self.out.suffix.lower() != ".csv":
            raise InvalidInput("output file", self.out, "a path that ends in .csv")
        check_place(self.out)
        estimate, cameras = read_estimated(self.state), read_observation(self.observation).cameras
        write_atomically(self.out, bop_results(estimate, cameras, self.scene, self.models, self.seconds).encode())
        count = len(cameras) * len(estimate.state.names)
        if not self.json:
            print(f"Wrote {self.out}: {count} poses in {len(cameras)} images of scene {self.scene}.")
        return {"out": str(self.out), "scene": self.scene, "images": len(cameras), "poses": count}
