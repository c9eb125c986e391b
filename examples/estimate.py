"""Estimate poses and the light from four images with masks, rendered here; prints each stage and the final errors."""

import numpy as np
from scene import table

from osfcore import (
    FieldLibrary,
    ObjectModels,
    Observation,
    Quality,
    SceneBatch,
    default_cameras,
    estimate_first,
    rotation_angle,
)


def main() -> None:
    """Render an observation of a known scene, and find that scene again."""
    truth, library = table(), FieldLibrary(None)
    models = ObjectModels({name: library.load(name) for name in truth.names}, library.load_table())
    cameras = default_cameras()
    rendered = models.together.render(
        SceneBatch.of(truth), cameras, quality=Quality(samples_per_side=2), outputs={"rgb", "masks"}
    )
    observation = Observation(cameras, rendered.rgb[0], truth.names, rendered.masks[0], truth.pusher, 0.0)
    stage, step = "", None
    for step in estimate_first(models, observation, np.random.default_rng(0)):
        if step.stage != stage:
            stage = step.stage
            print(f"{step.progress.done:3d} of {step.progress.total}: {stage}")
    found = step.estimate.state
    shift = 1000 * np.linalg.norm(found.poses.position - truth.poses.position, axis=1)
    turn = np.rad2deg(rotation_angle(found.poses.quaternion, truth.poses.quaternion))
    light = np.rad2deg(np.arccos(np.clip(found.light.direction @ truth.light.direction, -1, 1)))
    for name, mm, deg in zip(truth.names, shift, turn, strict=True):
        print(f"{name}: {mm:.2f} mm, {deg:.2f} deg off")
    print(f"light: {light:.2f} deg off; doubts: {step.estimate.reason or 'none'}")


if __name__ == "__main__":
    main()
