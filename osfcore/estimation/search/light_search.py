"""Light search: the direction toward the light by coarse-to-fine grid search, given roughly known poses.

A grid over the hemisphere and a ring at the elevation that the table's shading tells, then shrinking 3 x 3 grids around
the best directions, ranked by the truncated absolute error mean(min(|r|, e_max)) of renderings with shadows. Lit parts
of the table reflect ambient + direct * sin(elevation); cast shadows tell the azimuth; neither needs accurate poses.
Without the ring lights near the horizon are missed: there shading changes by half from one direction to the next.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from jaxtyping import Float

from osfcore.estimation.objective.object_models import QUALITY, ObjectModels
from osfcore.estimation.objective.observed_views import ObservedViews
from osfcore.estimation.objective.parametrization import LIGHT, SceneParameters
from osfcore.estimation.objective.resting_orientations import fibonacci_sphere
from osfcore.estimation.photometry.table_check import lit_table_level
from osfcore.geometry.light import MIN_LIGHT_ELEVATION_DEG, Light

_DIRECTIONS = 300  # over the whole sphere: about 12 degrees apart
_AZIMUTHS = 48  # of a ring at the horizon; higher ones are shorter
_FIRST_STEP_RAD = np.deg2rad(8.0)
_ROUNDS, _SHRINKING = 6, 0.6  # of the step from round to round
_MAX_ERROR = 0.25  # e_max [radiance]: orientations may still be wrong
_FIRST_SURVIVORS, _SURVIVORS = 6, 3  # local minima arise where shadows fall on other objects
_NEIGHBOUR_OFFSETS = np.array([(a, b) for a in (0, -1, 1) for b in (0, -1, 1)], float)


def search_light(
    models: ObjectModels, coarse: ObservedViews, fine: ObservedViews, params: SceneParameters
) -> Float[np.ndarray, "3"]:
    """Unit vector toward the light under which a rendering of the guessed poses fits the images best.

    Args:
        models: fields.
        coarse: images to try the whole hemisphere on.
        fine: images to refine on.
        params: objects and pusher; its light plays no part.

    Returns:
        The direction.
    """
    directions = np.concatenate([hemisphere(), _ring(models, fine)])
    best = directions[np.argsort(_losses(models, coarse, params, directions))[:_FIRST_SURVIVORS]]
    step = _FIRST_STEP_RAD
    for _ in range(_ROUNDS):
        tried = np.concatenate([_neighbours(params, light, step) for light in best])
        best = tried[np.argsort(_losses(models, fine, params, tried))[:_SURVIVORS]]
        step *= _SHRINKING
    return best[0]


def light_loss_ratio(models: ObjectModels, views: ObservedViews, params: SceneParameters) -> float:
    """Least truncated error on the grid over the hemisphere, divided by the error under the guess's own light.

    Args:
        models: fields.
        views: images to compare with; coarse ones will do.
        params: the guess.
    """
    directions = np.concatenate([params.light[None], hemisphere()])
    losses = _losses(models, views, params, directions)
    return float(losses[1:].min() / max(losses[0], 1e-12))


def hemisphere(count: int = _DIRECTIONS) -> Float[np.ndarray, "K 3"]:
    """Where a light may be: those of `count` directions, spread over the whole sphere, that are high enough."""
    directions = fibonacci_sphere(count)
    return directions[directions[:, 2] > np.sin(np.deg2rad(MIN_LIGHT_ELEVATION_DEG))]


def _ring(models: ObjectModels, views: ObservedViews) -> Float[np.ndarray, "K 3"]:
    """Directions from all around at the elevation that the table's lit pixels tell; none where none is seen."""
    level = lit_table_level(models, views)
    if level is None:
        return np.zeros((0, 3))
    elevation = np.arcsin(np.clip(level, np.sin(np.deg2rad(MIN_LIGHT_ELEVATION_DEG)), 1))
    count = int(np.ceil(_AZIMUTHS * np.cos(elevation))) + 1
    azimuths = 2 * np.pi * np.arange(count) / count
    return np.stack([Light.from_angles(azimuth, elevation).direction for azimuth in azimuths])


def _neighbours(params: SceneParameters, light: np.ndarray, step: float) -> Float[np.ndarray, "9 3"]:
    changes = np.zeros((len(_NEIGHBOUR_OFFSETS), params.size))
    changes[:, -LIGHT:] = step * _NEIGHBOUR_OFFSETS
    return replace(params, light=light).perturbed(changes).lights


def _losses(
    models: ObjectModels, views: ObservedViews, params: SceneParameters, lights: np.ndarray
) -> Float[np.ndarray, "B"]:
    batch = replace(params.perturbed(np.zeros((len(lights), params.size))), lights=lights)
    rendered = models.together.render(batch, views.cameras, quality=QUALITY)
    return np.minimum(np.abs(rendered.rgb - views.images), _MAX_ERROR).mean(axis=(1, 2, 3, 4))
