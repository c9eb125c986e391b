"""Algorithm 1 in the simulator: look, estimate, plan, push, look again. Needs meshes: run `osf assets fetch` first."""

import sys
from pathlib import Path

import numpy as np

from osfcore import (
    AssetLibrary,
    Episode,
    EpisodeParts,
    EpisodeSettings,
    FieldLibrary,
    GoalImage,
    SceneRequest,
    Tabletop,
    goal_camera,
    load_scene_models,
    random_goal,
)

NAMES = ("005_tomato_soup_can", "009_gelatin_box")


def main(objects: Path, steps: int = 20, parts: EpisodeParts | None = None) -> None:
    """One object of two is brought to where a goal image shows it.

    Args:
        objects: the folder where `osf assets fetch` has put the objects.
        steps: most pushes.
        parts: cost, planner and estimators, if others than ours.
    """
    assets, rng = AssetLibrary(objects), np.random.default_rng(0)
    world = Tabletop(assets, request=SceneRequest(names=NAMES))
    world.arrange(1)
    start, camera = world.truth(), goal_camera()
    random_goal(world, seed=1, moved=1)
    goal = GoalImage(camera, world.render((camera,), with_pusher=False).images[0])
    world.restore(start)
    models = load_scene_models(NAMES, FieldLibrary(None), assets, None)
    settings = EpisodeSettings(steps=steps, despite_doubts=True)
    for event in Episode(world, models, goal, settings, rng, parts=parts).run():
        if type(event).__name__ not in ("Looking", "Planning"):
            print(type(event).__name__, getattr(event, "text", ""))
    world.close()


if __name__ == "__main__":
    from app.storage.paths import default_data_dir

    main(Path(sys.argv[1]) if len(sys.argv) > 1 else default_data_dir() / "objects")
