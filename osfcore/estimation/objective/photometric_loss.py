"""The photometric loss of whole scenes: objects, pusher, table and shadows against the images (paper eq. 6)."""

from __future__ import annotations

import numpy as np
from jaxtyping import Float, Float32

from osfcore.estimation.objective.object_models import ObjectModels
from osfcore.estimation.objective.observed_views import ObservedViews
from osfcore.estimation.objective.parametrization import SceneParameters
from osfcore.render.types import SceneBatch

HUBER = 0.1  # h [radiance]


def residuals(models: ObjectModels, views: ObservedViews, batch: SceneBatch) -> Float32[np.ndarray, "B V h w 3"]:
    """Rendered minus observed [radiance]; 0 where pixels do not count.

    Args:
        models: fields of the objects and the table.
        views: what was observed.
        batch: B scenes to render.
    """
    rendered = models.together.render(batch, views.cameras, quality=views.quality, only=views.only)
    return rendered.rgb - views.images


def photometric_loss(errors: Float[np.ndarray, "B *pixels"]) -> Float[np.ndarray, "B"]:
    """Mean Huber loss over all pixels and colours of each scene.

    rho(r) = r^2 / 2 for |r| < h, h (|r| - h / 2) otherwise, with h = HUBER.

    Deviation from paper eq. 6, the mean square: outliers such as specular highlights count linearly.
    """
    size = np.abs(errors.reshape(len(errors), -1))
    return np.where(size < HUBER, 0.5 * size * size, HUBER * (size - 0.5 * HUBER)).mean(axis=1, dtype=float)


def loss_of(models: ObjectModels, views: ObservedViews, params: SceneParameters) -> float:
    """Photometric loss of one scene.

    Args:
        models: fields of the objects and the table.
        views: what was observed.
        params: the scene.
    """
    return float(photometric_loss(residuals(models, views, params.perturbed(np.zeros((1, params.size)))))[0])
