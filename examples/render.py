"""Render two objects through their neural fields, under a light that walks around the table: relit.png."""

import numpy as np
from scene import table

from osfcore import FieldLibrary, Light, Quality, SceneBatch, SceneRenderer, goal_camera, to_uint8, write_png


def main() -> None:
    """Write four pictures side by side, each under another light."""
    from pathlib import Path

    state, library = table(), FieldLibrary(None)
    renderer = SceneRenderer({name: library.load(name) for name in state.names}, library.load_table())
    lights = [Light.from_angles(azimuth, np.deg2rad(25)).direction for azimuth in np.linspace(0, 2 * np.pi, 4, False)]
    count = len(lights)
    batch = SceneBatch(
        state.names,
        np.tile(state.poses.position, (count, 1, 1)),
        np.tile(state.poses.quaternion, (count, 1, 1)),
        np.array(lights),
        None,
    )
    images = renderer.render(batch, (goal_camera(256),), quality=Quality(samples_per_side=2)).rgb[:, 0]
    write_png(Path("relit.png"), to_uint8(np.concatenate(list(images), axis=1)))
    print("relit.png: one table under four lights; mean radiance", np.round(images.mean(axis=(1, 2, 3)), 3).tolist())


if __name__ == "__main__":
    main()
