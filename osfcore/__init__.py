"""Object-centric neural scattering functions for multi-object manipulation: the core, free of user interfaces.

A map of the rooms, each importing only from those above it:

    geometry     poses, rotations, cameras, light, scene states, rollouts, convex parts
    io           file formats with their checks: scenes, states, observations, image sets, pushes, rollouts
    client       the service over REST, in the core's own types
    objects      the catalogue of objects, their meshes, and the library on disk
    metrics      errors of poses and images, success of rearrangements
    fields       neural scattering functions (OSF, KiloOSF), the table's field, and their training
    render       volume rendering of many fields on the table: a reference and a fast path
    estimation   images to poses and light: CMA-ES, light search, Gauss-Newton, template matching
    photo        real photographs: reading them, board, masks, poses and lamp
    dynamics     what a push does: contact graph and propagation network
    planning     MPPI, costs, push primitives, path planning
    control      Algorithm 1 of the paper as a generator of events over a `World`
    robots       robots over HTTP and ROS 2 as worlds; limits and a stop around any world
    paper        the paper's dynamics model as published, to compare ours with
    world        the simulated tabletop (PyBullet) and data collection
    export       scenes and fields as files that other programs open: binary glTF, USD, Gaussian splats
    environments the tabletop as a Gymnasium environment, for programs that learn
    inspection   checks of files, and pictures of how they were understood
    experiments  evaluations and benchmarks; only the command line imports it

Letters of array shapes: V views, N objects, h w pixels, R rays, S samples a ray, K action sequences, T planning steps,
B scenes of a batch.

Conventions: SI units; z up, the table top is z = 0; unit quaternions (w, x, y, z); `T_a_b` maps coordinates in b to
coordinates in a; OpenCV cameras; images are linear RGB in [0, 1].

The names below are loaded when they are first used: `import osfcore` alone loads nothing heavy.
"""

from __future__ import annotations

import importlib
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from osfcore.control.closed_loop import Episode
    from osfcore.control.estimators import SceneModels, load_scene_models
    from osfcore.control.first_frame import estimate_first
    from osfcore.control.goal import GoalImage
    from osfcore.dynamics.rollout import PushModel, load_push_model
    from osfcore.errors import OsfError
    from osfcore.estimation.goal_image import estimate_goal
    from osfcore.estimation.objective import ObjectModels
    from osfcore.estimation.tracking import estimate_next
    from osfcore.fields.field_library import FieldLibrary
    from osfcore.fields.kiloosf import KiloOSF
    from osfcore.geometry.cameras import Camera, default_cameras, goal_camera
    from osfcore.geometry.light import Light
    from osfcore.geometry.poses import Pose
    from osfcore.geometry.states import Observation, SceneState
    from osfcore.objects.asset_library import AssetLibrary
    from osfcore.planning.mppi import MPPIPlanner
    from osfcore.render.renderer import SceneRenderer
    from osfcore.render.types import SceneBatch
    from osfcore.world.tabletop import Tabletop

_HOMES = {
    "AssetLibrary": "objects.asset_library",
    "Camera": "geometry.cameras",
    "Episode": "control.closed_loop",
    "FieldLibrary": "fields.field_library",
    "GoalImage": "control.goal",
    "KiloOSF": "fields.kiloosf",
    "SceneModels": "control.estimators",
    "Light": "geometry.light",
    "ObjectModels": "estimation.objective",
    "Observation": "geometry.states",
    "OsfError": "errors",
    "MPPIPlanner": "planning.mppi",
    "Pose": "geometry.poses",
    "PushModel": "dynamics.rollout",
    "SceneBatch": "render.types",
    "SceneRenderer": "render.renderer",
    "SceneState": "geometry.states",
    "Tabletop": "world.tabletop",
    "default_cameras": "geometry.cameras",
    "estimate_first": "control.first_frame",
    "estimate_goal": "estimation.goal_image",
    "estimate_next": "estimation.tracking",
    "goal_camera": "geometry.cameras",
    "load_scene_models": "control.estimators",
    "load_push_model": "dynamics.rollout",
}
__all__ = [
    "AssetLibrary",
    "Camera",
    "Episode",
    "FieldLibrary",
    "GoalImage",
    "KiloOSF",
    "Light",
    "MPPIPlanner",
    "ObjectModels",
    "Observation",
    "OsfError",
    "Pose",
    "PushModel",
    "SceneBatch",
    "SceneModels",
    "SceneRenderer",
    "SceneState",
    "Tabletop",
    "default_cameras",
    "estimate_first",
    "estimate_goal",
    "estimate_next",
    "goal_camera",
    "load_push_model",
    "load_scene_models",
]


def __getattr__(name: str) -> Any:  # noqa: ANN401  whatever the name stands for
    """Import a public name from its room when it is first used."""
    if name not in _HOMES:
        raise AttributeError(f"module 'osfcore' has no attribute {name!r}; it has {', '.join(sorted(_HOMES))}")
    value = getattr(importlib.import_module(f"osfcore.{_HOMES[name]}"), name)
    globals()[name] = value
    return value


def __dir__() -> list[str]:
    """The public names, loaded or not."""
    return sorted(_HOMES)
