"""The rendering process: takes orders, renders them, answers. It starts when somebody first wants a picture.

Only `renderer_main` is imported by the web process, by name; compiled code loads in the child.
"""

from __future__ import annotations

from dataclasses import replace
from functools import lru_cache
from pathlib import Path
from typing import TYPE_CHECKING, Any

import cv2
import numpy as np
from jaxtyping import UInt8

from osfcore.estimation.camera_response import linear_from_encoded, srgb_of_linear
from osfcore.estimation.steps import ContentCheck
from osfcore.fields.field_library import TABLE_NAME, FieldLibrary
from osfcore.geometry.cameras import Camera
from osfcore.geometry.states import Observation, SceneState
from osfcore.io.image_file import encode_png, to_uint8
from osfcore.render.types import EXACT, PLANNING, Quality, SceneBatch

from .child_process import give_way
from .messages.neural_messages import CheckPhoto, CompareView, Comparison, DrawnView, DrawPhoto, DrawView, Order
from .render_cameras import bands
from .server import IsOvertaken, ProcessServer

if TYPE_CHECKING:
    from osfcore.estimation.content_check import ContentChecker
    from osfcore.fields.kiloosf import KiloOSF
    from osfcore.render.renderer import SceneRenderer

DIFFERENCE_GAIN = 4  # as in the pictures that a training shows
_MOST_RENDERERS = 4
# Cameras blend what falls into one pixel, so a fair comparison does so too.
_COMPARED = replace(EXACT, samples_per_side=2)


def renderer_main(server: ProcessServer, data_dir: Path) -> None:
    """Carry out orders until the service has gone."""
    give_way()  # to the simulation, and to what serves the page
    server.serve(NeuralRenderer(FieldLibrary(data_dir)).render)


class NeuralRenderer:
    """Renders orders; keeps the fields of the latest scenes, and reads a field again when its file has changed."""

    def __init__(self, fields: FieldLibrary) -> None:
        self._fields = fields
        # Both are found by the names of objects and the stamps of their files. A photo is checked when it comes, or
        # when the table changes, so one checker is enough.
        self._renderer = lru_cache(_MOST_RENDERERS)(self._new_renderer)
        self._checker = lru_cache(1)(self._new_checker)

    def render(
        self, order: Order, is_overtaken: IsOvertaken = lambda: False
    ) -> DrawnView | Comparison | ContentCheck | bytes | None:
        """What answers an order; None if it was overtaken on the way.

        Raises:
            UnknownName: if an object has no field.
            CorruptFile: if a field, or the table's, is broken.
        """
        match order:
            case DrawView():
                return self._draw(order, is_overtaken)
            case CompareView():
                return self._compare(order)
            case DrawPhoto():
                return self._photograph(order)
            case CheckPhoto():
                return self._check(order)
            case _:
                raise TypeError(f"{type(order).__name__} is no picture")

    def _draw(self, order: DrawView, is_overtaken: IsOvertaken) -> DrawnView | None:
        quality, outputs = (EXACT, {"rgb", "depth"}) if order.is_sharp else (PLANNING, {"rgb"})
        images, depths = [], []
        for band in bands(order.camera):
            if is_overtaken():
                return None
            rgb, depth = self._picture(order.state, band, quality, outputs)
            images.append(to_uint8(rgb))
            depths.append(depth)
        return DrawnView(np.concatenate(images), np.concatenate(depths) if order.is_sharp else None)

    def _compare(self, order: CompareView) -> Comparison:
        from osfcore.metrics.image_errors import psnr

        pixels = _decoded(order.observed)
        rgb, _ = self._picture(order.state, order.camera, _COMPARED, {"rgb"})
        observed, rendered = pixels / np.float32(255), np.clip(rgb, 0, 1)
        difference = to_uint8(DIFFERENCE_GAIN * np.abs(rendered - observed))
        shown = to_uint8(rendered)
        side_by_side = np.concatenate([pixels, shown, difference], axis=1)
        return Comparison(encode_png(shown), encode_png(difference), encode_png(side_by_side), psnr(observed, rendered))

    def _photograph(self, order: DrawPhoto) -> bytes:
        def sized(picture: np.ndarray) -> np.ndarray:
            return cv2.resize(picture, (order.camera.width, order.camera.height), interpolation=cv2.INTER_AREA)

        rgb, _ = self._picture(order.state, order.camera, _COMPARED, {"rgb"})
        photo = linear_from_encoded(sized(_decoded(order.photo)) / 255, "srgb")
        shown = np.any([sized(_decoded(mask))[..., 0] > 127 for mask in order.masks], axis=0)
        if shown.any():  # the exposure of the photo is not known
            rgb = rgb * (np.median(photo[shown]) / max(float(np.median(rgb[shown])), 1e-3))
        return encode_png(to_uint8(srgb_of_linear(np.clip(rgb, 0, 1))))

    def _check(self, order: CheckPhoto) -> ContentCheck:
        image = _decoded(order.photo)[None] / np.float32(255)
        observation = Observation((order.camera,), image, order.state.names, None, None, 0.0)
        return self._checker(*self._key(order.state.names)).check(observation, order.state)

    def _picture(
        self, state: SceneState, camera: Camera, quality: Quality, outputs: set[str]
    ) -> tuple[np.ndarray, np.ndarray | None]:
        renderer = self._renderer(*self._key(state.names))
        drawn = renderer.render(SceneBatch.of(state), (camera,), quality=quality, outputs=outputs)
        return drawn.rgb[0, 0], None if drawn.depth is None else drawn.depth[0, 0]

    def _new_renderer(self, names: tuple[str, ...], *_: object) -> SceneRenderer:
        from osfcore.render.renderer import SceneRenderer

        return SceneRenderer(self._load(names), self._fields.load_table())

    def _new_checker(self, names: tuple[str, ...], *_: object) -> ContentChecker:
        from osfcore.estimation.content_check import ContentChecker
        from osfcore.estimation.objective import ObjectModels

        return ContentChecker(ObjectModels(self._load(names), self._fields.load_table()))

    def _load(self, names: tuple[str, ...]) -> dict[str, KiloOSF]:
        return {name: self._fields.load(name) for name in names}

    def _key(self, names: tuple[str, ...]) -> tuple[Any, ...]:
        return names, *(self._fields.stamp(name) for name in (*names, TABLE_NAME))


def _decoded(png: bytes) -> UInt8[np.ndarray, "h w 3"]:
    decoded = cv2.imdecode(np.frombuffer(png, np.uint8), cv2.IMREAD_COLOR)
    assert decoded is not None
    return decoded[..., ::-1]
