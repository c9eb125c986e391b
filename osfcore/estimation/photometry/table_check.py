"""Whether pictures show the table as it is known, from its pixels alone: a check before any estimate.

Every pixel of the known table obeys I_c = albedo_c (ambient + x direct), with x = 0 in shadow and the same x where
the lamp reaches it. Another exposure, response or ambient light moves the shadows away from x = 0, another table
changes the colours. Where no shadow is seen, as under a lamp overhead, only colours tell.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

import cv2
import numpy as np
from jaxtyping import Bool, Float

from osfcore.estimation.objective.object_models import QUALITY, ObjectModels
from osfcore.estimation.objective.observed_views import ObservedViews
from osfcore.estimation.search.pose_initialization import OVERHEAD
from osfcore.geometry.light import AMBIENT, DIFFUSE
from osfcore.geometry.workspace import PUSHER_HEIGHT_M, PUSHER_RADIUS_M
from osfcore.render.types import SceneBatch

TableVerdict = Literal["usual", "unclear", "other"]
_MASK_ERROR_PX, _BESIDE = 2, 0.02  # of masks, and of the image's side: where nothing is table for sure
_FEWEST = 200  # pixels of table, without which nothing is told
_DARKEST = 0.001, 0.003  # shares of the pixels; where both lie well in shadow, it is as dark everywhere
_SAME = 0.025  # difference of x within a shadow
_SHADOW, _BRIGHTEST = 0.05, 1.06  # |x| in shadow, and x in full light
_LEAST_CONTRAST = 0.05  # of x: less is noise, not a shadow
_COLOUR = 0.012  # median error of colours [radiance]
_LIT, _FEWEST_LIT = 0.03, 20  # least x of a lit pixel, and how many each picture needs


@dataclass(frozen=True, slots=True)
class TableCheck:
    """What pixels of the table tell.

    Attributes:
        shadow: x of the darkest; 0 on the known table under the known ambient light.
        brightest: x of the brightest.
        colour: median error of the colours [radiance].
        verdict: "usual", or "other" where something speaks against the usual image model; "unclear" where no full
            shadow is seen: then another lamp may explain what another exposure does.
    """

    shadow: float
    brightest: float
    colour: float
    verdict: TableVerdict


def check_table(models: ObjectModels, views: ObservedViews) -> TableCheck:
    """Compare the table's pixels with the known table.

    Args:
        models: of which the table is used.
        views: pictures with masks.
    """
    x, error, on_table = table_light(models, views)
    table = _table_pixels(views, on_table)
    if table.sum() < _FEWEST:
        return TableCheck(0.0, 0.0, 0.0, "unclear")
    darkest, shadow, brightest = np.quantile(x[table], [*_DARKEST, 0.99])
    colour = float(np.median(error[table]))
    has_shadow = brightest - shadow > _LEAST_CONTRAST and shadow - darkest < _SAME
    is_dark = abs(shadow) < _SHADOW if has_shadow else darkest > -_SHADOW
    is_usual = is_dark and brightest < _BRIGHTEST and colour < _COLOUR
    verdict: TableVerdict = "other" if not is_usual else "usual" if has_shadow else "unclear"
    return TableCheck(float(shadow), float(brightest), colour, verdict)


def table_light(
    models: ObjectModels, views: ObservedViews
) -> tuple[Float[np.ndarray, "V h w"], Float[np.ndarray, "V h w"], Bool[np.ndarray, "V h w"]]:
    """What would be the light on the table, if every pixel showed it.

    Args:
        models: of which the table is used.
        views: pictures.

    Returns:
        x by which the pixel's radiance is best explained, the error of its colours that this leaves [radiance], and
        whether the table would be seen if it were empty.
    """
    nothing = SceneBatch((), np.zeros((1, 0, 3)), np.zeros((1, 0, 4)), OVERHEAD[None], None)
    empty = models.together.render(nothing, views.cameras, quality=QUALITY, outputs={"rgb", "depth"})
    assert empty.depth is not None
    full = empty.rgb[0]
    seen = np.stack([cv2.blur(image, (3, 3)) for image in views.images])
    # The known table facing the lamp sends out `full`, that is ambient and all direct light.
    lit = (seen * full).sum(axis=-1) / np.maximum((full * full).sum(axis=-1), 1e-6)
    error = np.abs(seen - lit[..., None] * full).mean(axis=-1)
    return (lit - AMBIENT) / DIFFUSE, error, empty.depth[0] > 0


def lit_table_level(models: ObjectModels, views: ObservedViews) -> float | None:
    """Light x = sin(elevation) on the table where the lamp reaches it: the median over pixels of its colours.

    Args:
        models: of which the table is used.
        views: pictures; masks play no part.

    Returns:
        x, or None where too little of a lit table is seen.
    """
    x, error, on_table = table_light(models, views)
    lit = x[on_table & (error < _COLOUR) & (x > _LIT)]
    return float(np.median(lit)) if len(lit) >= _FEWEST_LIT * len(views.images) else None


def _table_pixels(views: ObservedViews, on_table: np.ndarray) -> np.ndarray:
    """Pixels that show nothing but table, well within its edge."""
    reach = _MASK_ERROR_PX + round(_BESIDE * max(on_table.shape[1:]))
    kernel = np.ones((2 * reach + 1,) * 2, np.uint8)
    other = ~on_table
    if views.masks is not None and views.masks.shape[1]:
        other |= views.masks.max(axis=1) > 0
    if views.pusher is not None:
        other |= _pusher_pixels(views)
    return np.stack([cv2.dilate(part.astype(np.uint8), kernel) == 0 for part in other])


def _pusher_pixels(views: ObservedViews) -> np.ndarray:
    """The pusher's outline in each view, about, from points of its axis."""
    assert views.pusher is not None
    shown = np.zeros(views.images.shape[:3], np.uint8)
    axis = views.pusher + np.linspace(-0.5, 0.5, 9)[:, None] * [0.0, 0.0, PUSHER_HEIGHT_M]
    for picture, camera in zip(shown, views.cameras, strict=True):
        depth = camera.T_world_camera.inverse().apply(axis)[:, 2]
        if depth.min() <= PUSHER_RADIUS_M:
            continue
        radius = int(np.ceil(camera.intrinsics[0, 0] * PUSHER_RADIUS_M / depth.min()))
        for x, y in camera.project(axis):
            cv2.circle(picture, (int(x), int(y)), radius, 1, -1)
    return shown > 0
