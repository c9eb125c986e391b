"""The image model for unknown exposure, response, ambient light and table: a check, and a fit at known poses."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass, replace
from typing import Literal

import cv2
import numpy as np
from jaxtyping import Bool, Float, Float32

from osfcore.estimation.camera_response import ImageModel
from osfcore.estimation.objective import ObjectModels, ObservedViews, SceneParameters, empty_scene
from osfcore.estimation.search import (
    FIRST_STEP_RAD,
    LIGHT_ROUNDS,
    SHRINKING,
    TABLE_COLOUR,
    hemisphere,
    light_neighbours,
    table_light,
)
from osfcore.fields.kiloosf import KiloOSF
from osfcore.fields.table import TableField
from osfcore.geometry.workspace import PUSHER_HEIGHT_M, PUSHER_RADIUS_M

# A check before any estimate whether images show the table as expected, from its pixels alone.
#
# Every pixel of the known table obeys I_c = albedo_c (ambient + x direct), with x = 0 in shadow and the same x
# where the lamp reaches it. Another exposure, response or ambient light moves the shadows away from x = 0, another
# table changes the colours. Where no shadow is seen, as under a lamp overhead, only colours can differ.


TableVerdict = Literal["usual", "unclear", "other"]
_MASK_ERROR_PX, _BESIDE = 2, 0.02  # of masks, and of the image's side: where nothing is table for sure
_FEWEST = 200  # pixels of table, without which nothing is decided
_DARKEST = 0.001, 0.003  # shares of the pixels; where both lie well in shadow, it is as dark everywhere
_SAME = 0.025  # difference of x within a shadow
_SHADOW, _BRIGHTEST = 0.05, 1.06  # |x| in shadow, and x in full light
_LEAST_CONTRAST = 0.05  # of x: less is noise, not a shadow


def check_table(models: ObjectModels, views: ObservedViews) -> TableVerdict:
    """Compare the table's pixels with the known table.

    Args:
        models: models, of which only the table is used.
        views: images with masks.

    Returns:
        "usual" if the table looks as expected; "other" if it does not; "unclear" if no full shadow is visible, because
        another lamp and another exposure then look the same.
    """
    x, error, on_table = table_light(models, views)
    table = _table_pixels(views, on_table)
    if table.sum() < _FEWEST:
        return "unclear"
    darkest, shadow, brightest = np.quantile(x[table], [*_DARKEST, 0.99])
    colour = float(np.median(error[table]))
    has_shadow = brightest - shadow > _LEAST_CONTRAST and shadow - darkest < _SAME
    is_dark = abs(shadow) < _SHADOW if has_shadow else darkest > -_SHADOW
    is_usual = is_dark and brightest < _BRIGHTEST and colour < TABLE_COLOUR
    if not is_usual:
        return "other"
    return "usual" if has_shadow else "unclear"


def _table_pixels(views: ObservedViews, on_table: np.ndarray) -> np.ndarray:
    """Return which pixels show only table, well within its edge."""
    reach = _MASK_ERROR_PX + round(_BESIDE * max(on_table.shape[1:]))
    kernel = np.ones((2 * reach + 1,) * 2, np.uint8)
    other = ~on_table
    if views.masks is not None and views.masks.shape[1]:
        other |= views.masks.max(axis=1) > 0
        if views.unmasked is not None:  # the object may be anywhere
            other |= np.any(views.unmasked, axis=1)[:, None, None]
    if views.pusher is not None:
        other |= _pusher_pixels(views)
    return np.stack([cv2.dilate(part.astype(np.uint8), kernel) == 0 for part in other])


def _pusher_pixels(views: ObservedViews) -> np.ndarray:
    """Return which pixels show the pusher, approximately, from points on its axis."""
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


# Fields and tables adapted to an image model, by factors on albedo and ambient light.


_ALBEDO = slice(1, 4)  # among a field's features


def adapted(models: ObjectModels, names: Iterable[str], model: ImageModel) -> ObjectModels:
    """Return models of some objects that look as images normalized by `ImageModel.normalized`.

    Args:
        models: models that are not adapted yet.
        names: names of the objects.
        model: image model of the images.
    """
    return models.changed(
        names, lambda field: scaled_field(field, model.scale, model.ambient), lambda table: _adapted_table(table, model)
    )


def _adapted_table(table: TableField, model: ImageModel) -> TableField:
    scaled = scaled_table(table, model.scale * model.table, model.ambient)
    if model.surroundings is None:
        return scaled
    return replace(scaled, background=(model.surroundings * model.scale / model.gain).astype(np.float32))


def scaled_field(field: KiloOSF, albedo: float, ambient: float) -> KiloOSF:
    """Return a field with factors on its albedo and on its ambient light."""
    rows = field.rows.copy()
    rows[:, _ALBEDO] *= np.float32(albedo)
    return replace(field, rows=rows, ambient=field.ambient * np.float32(ambient))


def scaled_table(table: TableField, albedo: Float[np.ndarray, "3"], ambient: float) -> TableField:
    """Return a table with factors on its albedo, per colour, and on its ambient light."""
    factors = np.asarray(albedo, np.float32)
    return replace(table, albedo=table.albedo * factors, ambient=table.ambient * np.float32(ambient))


# The image model from roughly known poses: exposure, ambient light, table and lamp at once.
#
# With E the rendered ambient part of a scene and S(l) the rendered direct part under a lamp from l, shadows
# included,
#
#     I_c = G_c (r E_c + S_c(l))            on objects,
#     I_c = G_c T_c (r E_c + S_c(l))        on the table,
#
# so that for each l and r the gains are two small least-squares problems, weighted by truncated errors. l and r are
# searched: over the hemisphere and a range of r, then on shrinking grids around the best. Neither the exposure nor
# the table's colour enter: l and r follow from the shading of objects and the contrast of shadows on the table.


_AMBIENT = np.geomspace(0.2, 8.0, 11)  # r: shares of ambient light from 6 to 73 %
_FIRST_FACTOR = 1.3  # of r, from one place of the first grid to the next
_SURVIVORS = 4
_TRUNCATED = 0.25  # of the pictures' mean brightness: shadows that are elsewhere, and wrong sides of objects
_OPAQUE, _CLEAR = 0.9, 0.05  # shares of pixels that count as an object's, and as the table's
_SATURATED, _DARK = 0.985, 1e-6  # of full scale; where pictures are black, errors are relative to this


@dataclass(frozen=True, eq=False, slots=True)
class Calibration:
    """Image model and lamp of some images.

    Attributes:
        model: exposure, ambient light and table.
        light: unit vector toward the lamp.
        unexplained: mean truncated error of objects and of the table, relative to their brightness.
    """

    model: ImageModel
    light: Float[np.ndarray, "3"]
    unexplained: float


class Calibrator:
    """Fits image models to images.

    Args:
        models: models that are not adapted.
        names: names of the objects in the images.
    """

    def __init__(self, models: ObjectModels, names: tuple[str, ...]) -> None:
        white = np.ones(3)
        self._whole = models
        self._direct = models.changed(
            names,
            lambda field: scaled_field(field, 1.0, 0.0),
            lambda table: replace(scaled_table(table, white, 0.0), background=np.zeros(3, np.float32)),
        )

    def search(self, rough: ObservedViews, fine: ObservedViews, params: SceneParameters) -> Calibration:
        """Search lamp and image model without an initial guess.

        Args:
            rough: images to try the whole hemisphere on.
            fine: images to refine on.
            params: the objects. The light is ignored.
        """
        pixels = self._pixels(rough, params)
        directions = hemisphere()
        costs = pixels.costs(self._direct_parts(rough, params, directions, pixels), _AMBIENT)
        found = np.argsort(costs, axis=None)[: 2 * _SURVIVORS]
        best = [(directions[k // len(_AMBIENT)], float(_AMBIENT[k % len(_AMBIENT)])) for k in found]
        return self._refined(fine, params, best, FIRST_STEP_RAD, _FIRST_FACTOR, LIGHT_ROUNDS)

    def refine(self, views: ObservedViews, params: SceneParameters, ambient: float, *, hold_light: bool) -> Calibration:
        """Refine a calibration at known poses.

        Args:
            views: the images.
            params: objects and lamp, close to the truth.
            ambient: r, close to the truth.
            hold_light: whether the lamp stays fixed.
        """
        step = 0.0 if hold_light else FIRST_STEP_RAD / 4
        return self._refined(views, params, [(params.light, ambient)], step, _FIRST_FACTOR**0.5, 3, kept=1)

    def _refined(
        self,
        views: ObservedViews,
        params: SceneParameters,
        best: list[tuple[np.ndarray, float]],
        step: float,
        factor: float,
        rounds: int,
        kept: int = _SURVIVORS // 2,
    ) -> Calibration:
        pixels = self._pixels(views, params)
        cost = np.inf
        for _ in range(rounds):
            tried: list[tuple[float, np.ndarray, float]] = []
            for light, ambient in best:
                lights = light_neighbours(params, light, step) if step else light[None]
                around = ambient * factor ** np.array([-1.0, 0.0, 1.0])
                costs = pixels.costs(self._direct_parts(views, params, lights, pixels), around)
                tried += [
                    (costs[a, b], lights[a], float(around[b])) for a in range(len(lights)) for b in range(len(around))
                ]
            tried.sort(key=lambda one: one[0])
            cost, best = tried[0][0], [(light, ambient) for _, light, ambient in tried[:kept]]
            step, factor = step * SHRINKING, factor**SHRINKING
        light, ambient = best[0]
        direct = self._direct_parts(views, params, light[None], pixels)[0]
        objects, table = pixels.gains(direct, ambient)
        model = ImageModel(objects, ambient, table / objects, surroundings=pixels.surroundings)
        return Calibration(model, light, float(cost))

    def _pixels(self, views: ObservedViews, params: SceneParameters) -> _Pixels:
        """Return the pixels that count, with their observed radiance and its rendered ambient part."""
        batch, nothing = params.repeated(), empty_scene(params.light)
        whole = self._whole.together.render(batch, views.cameras, quality=views.quality, outputs={"rgb", "opacity"})
        direct = self._direct.together.render(batch, views.cameras, quality=views.quality).rgb[0]
        empty, lit = (m.together.render(nothing, views.cameras, quality=views.quality).rgb[0]
                      for m in (self._whole, self._direct))  # fmt: skip
        assert whole.opacity is not None
        ambient, bare = whole.rgb[0] - direct, empty - lit
        opacity = whole.opacity[0].sum(axis=1)
        masks = np.zeros_like(opacity) if views.masks is None else views.masks.sum(axis=1)
        exposed = views.images.max(axis=-1) < _SATURATED
        objects = (opacity > _OPAQUE) & exposed
        if views.masks is not None:
            objects &= masks > _OPAQUE
        has_no_pusher = np.abs(ambient - bare).max(axis=-1) < 1e-3
        others = (opacity < _CLEAR) & (masks < _CLEAR) & has_no_pusher
        is_table = lit.max(axis=-1) > 0
        counted, beyond = objects | (others & is_table & exposed), others & ~is_table
        surroundings = np.median(views.images[beyond], axis=0).astype(float) if beyond.any() else None
        return _Pixels(counted, objects[counted], views.images[counted], ambient[counted], surroundings)

    def _direct_parts(
        self, views: ObservedViews, params: SceneParameters, lights: np.ndarray, pixels: _Pixels
    ) -> Float32[np.ndarray, "L P 3"]:
        batch = replace(params.repeated(len(lights)), lights=lights)
        rendered = self._direct.together.render(batch, views.cameras, quality=views.quality, only=pixels.counted)
        return rendered.rgb[:, pixels.counted]


@dataclass(frozen=True, eq=False, slots=True)
class _Pixels:
    """P pixels that the model describes.

    Attributes:
        counted: mask of these pixels.
        of_objects: which of them show objects; the others show the table.
        seen: observed radiance.
        ambient: E, rendered ambient part.
        surroundings: median radiance beyond the table; None if nothing beyond it is visible.
    """

    counted: Bool[np.ndarray, "V h w"]
    of_objects: Bool[np.ndarray, "P"]
    seen: Float32[np.ndarray, "P 3"]
    ambient: Float32[np.ndarray, "P 3"]
    surroundings: Float[np.ndarray, "3"] | None

    def costs(self, direct: Float32[np.ndarray, "L P 3"], ambients: Float[np.ndarray, "R"]) -> np.ndarray:
        """Return the mean truncated errors, L x R."""
        costs = np.zeros((len(direct), len(ambients)))
        for kind in (self.of_objects, ~self.of_objects):
            if not kind.any():
                continue
            seen, ambient, own = self.seen[kind], self.ambient[kind], direct[:, kind]
            brightness = max(float(seen.mean()), _DARK)
            most = _TRUNCATED * brightness
            for number, r in enumerate(ambients):
                error = np.abs(_fit(np.float32(r) * ambient + own, seen, most)[1])
                costs[:, number] += np.minimum(error, most).mean(axis=(1, 2)) / brightness
        return costs

    def gains(self, direct: Float32[np.ndarray, "P 3"], ambient: float) -> tuple[np.ndarray, np.ndarray]:
        """Return the gains of objects and table, per colour. If one is not visible, it takes the other's gain."""
        found = []
        for kind in (self.of_objects, ~self.of_objects):
            if kind.any():
                shown, seen = np.float32(ambient) * self.ambient[kind] + direct[kind], self.seen[kind]
                found.append(_fit(shown[None], seen, _TRUNCATED * float(seen.mean()), 4)[0][0])
        if not found:
            return np.ones(3), np.ones(3)
        return found[0].astype(float), found[-1].astype(float)


def _fit(
    shown: Float32[np.ndarray, "L P 3"], seen: Float32[np.ndarray, "P 3"], most: float, rounds: int = 1
) -> tuple[Float32[np.ndarray, "L 3"], Float32[np.ndarray, "L P 3"]]:
    """Fit gains by least squares without the pixels whose error is above `most`; return them and the errors."""
    gains = _ratio((shown * seen).sum(axis=1), (shown * shown).sum(axis=1))
    for _ in range(rounds):
        weights = (np.abs(gains[:, None] * shown - seen) < most).astype(np.float32)
        weighted = weights * shown
        gains = _ratio((weighted * seen).sum(axis=1), (weighted * shown).sum(axis=1))
    return gains, gains[:, None] * shown - seen


def _ratio(upper: np.ndarray, lower: np.ndarray) -> np.ndarray:
    return np.maximum(upper, 1e-3) / np.maximum(lower, 1e-3)
