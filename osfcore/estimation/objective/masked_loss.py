"""The masked loss: one object rendered alone against the images inside its masks (paper eq. 5), many poses at once."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float, Float32

from osfcore.estimation.objective.object_models import ObjectModels
from osfcore.estimation.objective.observed_views import ObjectView
from osfcore.render.types import SceneBatch

COLOUR_WEIGHT = 6.0  # w: of the colour term against the silhouette term
_MAX_ERROR = 0.3  # e_max [radiance]
_LEAST_GAIN, _MOST_GAIN = 0.2, 4.0


@dataclass(frozen=True, eq=False, slots=True)
class RenderedObject:
    """Renderings of one object in B poses, cropped as its `ObjectView`.

    Attributes:
        rgb: over black.
        opacity: share of each pixel that shows it.
    """

    rgb: Float32[np.ndarray, "B V h w 3"]
    opacity: Float32[np.ndarray, "B V h w"]


def render_poses(
    models: ObjectModels,
    name: str,
    part: ObjectView,
    positions: Float[np.ndarray, "B 3"],
    quaternions: Float[np.ndarray, "B 4"],
    light: Float[np.ndarray, "3"],
) -> RenderedObject:
    """Render one object in B poses, alone.

    Args:
        models: fields.
        name: of the object.
        part: the crop whose cameras and quality are used.
        positions: of the object's origin [m].
        quaternions: rotations from the object's frame to the world, unit.
        light: unit vector toward the light, the same for all poses.
    """
    lights = np.tile(light, (len(positions), 1))
    batch = SceneBatch((name,), positions[:, None], quaternions[:, None], lights, None)
    rendered = models.alone.render(batch, part.cameras, quality=part.quality, outputs={"rgb", "opacity"})
    assert rendered.opacity is not None
    return RenderedObject(rendered.rgb, rendered.opacity[:, :, 0])


def masked_loss(look: RenderedObject, part: ObjectView, *, any_brightness: bool = False) -> Float[np.ndarray, "B"]:
    """Silhouette and colour error of each pose; 0 is perfect.

    With rendered opacity o, mask m, validity v, the mask's area A in each view, and P the pixels of both silhouettes:

        L = sum_views A / sum(A) * [ sum |o - m| v / A  +  w * sum_P min(|c_rendered - c_observed|, e_max) / A ]

    Deviations from paper eq. 5, the mean squared error inside the masks: absolute errors, truncated at e_max, so that
    shadows of other objects, which are not rendered here, do not decide; the silhouette is a term of its own; pixels
    that other objects may cover are left out.

    Args:
        look: rendered images of B poses.
        part: the observed crop of each view.
        any_brightness: scale colours by the least-squares factor of each pose and view: the light is not known yet.

    Returns:
        The loss of each pose.
    """
    silhouette = (np.abs(look.opacity - part.mask) * part.valid).sum(axis=(2, 3)) / part.area
    both = ((look.opacity > 0.5) & (part.mask > 0.5) & part.valid)[..., None]
    rgb = look.rgb
    if any_brightness:
        shown = rgb * both
        gain = (shown * part.rgb).sum(axis=(2, 3, 4)) / np.maximum((shown * shown).sum(axis=(2, 3, 4)), 1e-6)
        rgb = rgb * np.clip(gain, _LEAST_GAIN, _MOST_GAIN)[..., None, None, None]
    errors = np.minimum(np.abs(rgb - part.rgb), _MAX_ERROR) * both
    colour = errors.mean(axis=-1).sum(axis=(2, 3)) / part.area
    weights = part.area / part.area.sum()
    return ((silhouette + COLOUR_WEIGHT * colour) * weights).sum(axis=1).astype(float)
