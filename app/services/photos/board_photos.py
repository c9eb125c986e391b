"""Photographs of the board, from which a camera is calibrated; only where its corners are is kept, and in memory."""

from __future__ import annotations

import threading
import uuid
from collections.abc import Callable, Sequence

from app.processes.messages.photo_messages import AssessCamera, PhotoAnswer, PhotoOrder, SightBoard
from osfcore.errors import NotThere
from osfcore.geometry.poses import Pose
from osfcore.photo.calibration import Calibration, Sighting

_MOST_KEPT = 300  # of all visitors; the oldest are forgotten


class BoardPhotos:
    """Where the board is in photographs. Methods block; any thread may call.

    Args:
        ask: lets the process that looks at photographs carry out an order.
    """

    def __init__(self, ask: Callable[[PhotoOrder], PhotoAnswer]) -> None:
        self._ask = ask
        self._lock = threading.Lock()
        self._sightings: dict[str, Sighting] = {}

    def add(self, data: bytes, name: str) -> tuple[str, Sighting]:
        """Look for the board in a photograph; an identifier, and where it is.

        Raises:
            PhotoRefused: if it cannot be used, or shows no board.
            ProcessUnavailable: if what decodes it died.
        """
        sighting = self._ask(SightBoard(data, name))
        assert isinstance(sighting, Sighting)
        identifier = uuid.uuid4().hex[:12]
        with self._lock:
            self._sightings[identifier] = sighting
            while len(self._sightings) > _MOST_KEPT:
                del self._sightings[next(iter(self._sightings))]
        return identifier, sighting

    def assess(self, views: Sequence[str], table: str | None, T_world_board: Pose) -> Calibration:
        """What photographs tell of the camera so far; arguments as of the core's `assess`, photographs by identifier.

        Raises:
            UnknownName: if there is no such photograph.
            PhotoRefused: naming one that contradicts the others.
            InvalidInput: if all contradict each other.
            ProcessUnavailable: if what calibrates died.
        """
        seen = tuple(map(self._sighting, views))
        on_table = None if table is None else self._sighting(table)
        found = self._ask(AssessCamera(seen, on_table, T_world_board))
        assert isinstance(found, Calibration)
        return found

    def _sighting(self, identifier: str) -> Sighting:
        with self._lock:
            if identifier not in self._sightings:
                raise NotThere("photo of the board")
            return self._sightings[identifier]
