"""The rendering process: takes orders, renders them, answers. It starts when somebody first wants a picture.

Only `renderer_main` is imported by the web process, by name; compiled code loads in the child.
"""

from __future__ import annotations

import contextlib
import logging
import os
import signal
import threading
from collections import OrderedDict
from collections.abc import Callable
from dataclasses import replace
from multiprocessing.connection import Connection
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from app.processes.child_process import silence_stdout
from app.processes.messages import Failure, Reply
from app.processes.neural_messages import CompareView, Comparison, DrawnView, DrawView, NumberedOrder, Order
from app.processes.render_cameras import bands
from app.processes.request_queue import Inbox
from osfcore.errors import OsfError
from osfcore.fields.field_library import FIELD_FILE, TABLE_NAME, FieldLibrary

if TYPE_CHECKING:
    from osfcore.geometry.cameras import Camera
    from osfcore.geometry.states import SceneState
    from osfcore.render.scene_renderer import SceneRenderer
    from osfcore.render.types import Quality

DIFFERENCE_GAIN = 4  # as in the pictures that a training shows
MOST_PSNR_DB = 100.0
_NICENESS = 5  # the simulation, and what serves the page, come first
_MOST_RENDERERS = 4
_log = logging.getLogger(__name__)
CarryOut = Callable[[Order, Callable[[], bool]], object]  # an order, and what tells whether a newer one overtook it


def renderer_main(connection: Connection, data_dir: Path) -> None:
    """Serve orders until the other end is gone."""
    os.nice(_NICENESS)
    studio = Studio(FieldLibrary(data_dir))
    serve(connection, studio.render, "neural renderer")


def serve(connection: Connection, carry_out: CarryOut, who: str) -> None:
    """Carry out orders, one at a time, until the other end is gone.

    Args:
        connection: where they come from.
        carry_out: what answers one; raises OsfError where it refuses.
        who: what people call this process.
    """
    signal.signal(signal.SIGINT, signal.SIG_IGN)  # the web process decides when to stop
    silence_stdout()
    inbox, replies = Inbox(), Replies(connection)
    # Orders are read at once, however long work takes, so that whoever sends them never waits.
    threading.Thread(target=_listen, args=(connection, inbox, replies), daemon=True).start()
    while (order := inbox.take()) is not None:
        replies.send(_answer(carry_out, who, inbox, order))


class Replies:
    """The way back, for two threads."""

    def __init__(self, connection: Connection) -> None:
        self._connection = connection
        self._lock = threading.Lock()

    def send(self, reply: Reply | Failure) -> None:
        """Send an answer; does nothing once the other end is gone."""
        with self._lock, contextlib.suppress(OSError):
            self._connection.send(reply)


def _listen(connection: Connection, inbox: Inbox, replies: Replies) -> None:
    try:
        while True:
            overtaken = inbox.put(connection.recv())
            if overtaken is not None:
                replies.send(Reply(overtaken.number, None))
    except (EOFError, OSError):
        inbox.close()


def _answer(carry_out: CarryOut, who: str, inbox: Inbox, order: NumberedOrder) -> Reply | Failure:
    try:
        return Reply(order.number, carry_out(order.order, lambda: inbox.is_overtaken(order)))
    except OsfError as error:
        return Failure.of(error, order.number)
    except Exception as error:  # a defect must not end the orders of others
        _log.exception("the %s could not carry out an order", who)
        return Failure(order.number, "Internal", f"The {who} failed ({type(error).__name__}).")


class Studio:
    """Renders orders; keeps the fields of the latest scenes, and reads a field again when its file has changed."""

    def __init__(self, fields: FieldLibrary) -> None:
        self._fields = fields
        self._renderers: OrderedDict[object, SceneRenderer] = OrderedDict()

    def render(self, order: Order, is_overtaken: Callable[[], bool] = lambda: False) -> DrawnView | Comparison | None:
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
            case _:
                raise TypeError(f"{type(order).__name__} is no picture")

    def _draw(self, order: DrawView, is_overtaken: Callable[[], bool]) -> DrawnView | None:
        from osfcore.render.types import EXACT, PLANNING

        quality, outputs = (EXACT, {"rgb", "depth"}) if order.is_sharp else (PLANNING, {"rgb"})
        images, depths = [], []
        for band in bands(order.camera):
            if is_overtaken():
                return None
            rgb, depth = self._picture(order.state, band, quality, outputs)
            images.append(_eight_bit(rgb))
            depths.append(depth)
        return DrawnView(np.concatenate(images), np.concatenate(depths) if order.is_sharp else None)

    def _compare(self, order: CompareView) -> Comparison:
        import cv2

        from osfcore.render.types import EXACT

        decoded = cv2.imdecode(np.frombuffer(order.observed, np.uint8), cv2.IMREAD_COLOR)
        assert decoded is not None
        pixels = decoded[..., ::-1]
        # Cameras blend what falls into one pixel, so a fair comparison does so too.
        quality = replace(EXACT, samples_per_side=2)
        rgb, _ = self._picture(order.state, order.camera, quality, {"rgb"})
        observed, rendered = pixels / np.float32(255), np.clip(rgb, 0, 1)
        difference = _eight_bit(DIFFERENCE_GAIN * np.abs(rendered - observed))
        shown = _eight_bit(rendered)
        side_by_side = np.concatenate([pixels, shown, difference], axis=1)
        return Comparison(_png(shown), _png(difference), _png(side_by_side), psnr_db(rendered, observed))

    def _picture(
        self, state: SceneState, camera: Camera, quality: Quality, outputs: set[str]
    ) -> tuple[np.ndarray, np.ndarray | None]:
        from osfcore.render.types import SceneBatch

        drawn = self._renderer(state.names).render(SceneBatch.of(state), (camera,), quality=quality, outputs=outputs)
        return drawn.rgb[0, 0], None if drawn.depth is None else drawn.depth[0, 0]

    def _renderer(self, names: tuple[str, ...]) -> SceneRenderer:
        from osfcore.render.scene_renderer import SceneRenderer

        key = (names, *(self._stamp(name) for name in (*names, TABLE_NAME)))
        if key not in self._renderers:
            fields = {name: self._fields.load(name) for name in names}
            self._renderers[key] = SceneRenderer(fields, self._fields.load_table())
            while len(self._renderers) > _MOST_RENDERERS:
                self._renderers.popitem(last=False)
        self._renderers.move_to_end(key)
        return self._renderers[key]

    def _stamp(self, name: str) -> object:
        """Changes when a field is trained, trained again or deleted; those that ship with the program stay."""
        try:
            found = (self._fields.folder(name) / FIELD_FILE).stat()
        except OSError:
            return None
        return found.st_mtime_ns, found.st_size


def psnr_db(image: np.ndarray, truth: np.ndarray) -> float:
    """Peak signal-to-noise ratio of values in [0, 1] over all pixels and colours [dB]; 100 for equal images."""
    error = float(np.mean((image.astype(np.float64) - truth) ** 2))
    return min(-10 * np.log10(max(error, 1e-300)), MOST_PSNR_DB)


def _eight_bit(image: np.ndarray) -> np.ndarray:
    return np.round(np.clip(image, 0, 1) * 255).astype(np.uint8)


def _png(pixels: np.ndarray) -> bytes:
    import cv2

    _, data = cv2.imencode(".png", np.ascontiguousarray(pixels[..., ::-1]), [cv2.IMWRITE_PNG_COMPRESSION, 3])
    return data.tobytes()
