"""The first frame's loss: one object alone, compared inside its masks (paper eq. 5), for many poses at once."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float, Float32

from osfcore.estimation.objective.object_models import ObjectModels
from osfcore.estimation.objective.observed_views import ObjectView
from osfcore.render.types import SceneBatch

COLOUR_WEIGHT = 6.0  # of the colours' part against that of the silhouette
_MAX_ERROR = 0.3  # of radiance that counts: shadows of other objects are not rendered here
_LEAST_GAIN, _MOST_GAIN = 0.2, 4.0


@dataclass(frozen=True, eq=False, slots=True)
class RenderedObject:
    """An object in B poses, as each view of its part would show it.

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
    """Render one object in B poses under one light."""
    lights = np.tile(light, (len(positions), 1))
    batch = SceneBatch((name,), positions[:, None], quaternions[:, None], lights, None)
    rendered = models.alone.render(batch, part.cameras, quality=part.quality, outputs={"rgb", "opacity"})
    assert rendered.opacity is not None
    return RenderedObject(rendered.rgb, rendered.opacity[:, :, 0])


def masked_loss(look: RenderedObject, part: ObjectView, *, any_brightness: bool = False) -> Float[np.ndarray, "B"]:
    """How badly each pose explains the masks and the colours in them; 0 is perfect.

    Deviations from paper eq. 5: absolute differences instead of squares, cut off, so that shadows cannot decide; the
    silhouettes count on their own; pixels that other objects cover tell nothing.

    Args:
        look: what was rendered.
        part: what was observed.
        any_brightness: compare up to one factor per pose and view: the light is not known yet.
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
    share = part.area / part.area.sum()
    return ((silhouette + COLOUR_WEIGHT * colour) * share).sum(axis=1).astype(float)
