"""The service's end of the process that looks at photographs."""

from __future__ import annotations

import threading

from app.processes.client import ProcessClient, ProcessHangs
from app.processes.messages.photo_messages import PhotoAnswer, PhotoOrder
from app.processes.photo_process import PhotoRefused, photo_main

_PATIENCE_S = 30.0  # sound photos take three, and a busy machine some to start the process


class PhotoLooker:
    """Lets orders be carried out one at a time; the process starts with the first one, and again if it dies."""

    def __init__(self) -> None:
        self._process = ProcessClient(photo_main, (), "reader of photos", answer_s=_PATIENCE_S)
        self._one_at_a_time = threading.Lock()  # so that none waits for another's time

    def ask(self, order: PhotoOrder) -> PhotoAnswer:
        """Let an order be carried out. Blocks; any thread may call.

        Raises:
            PhotoRefused: if the photo cannot be used, or takes too long.
            InvalidInput: if the order makes no sense.
            ProcessUnavailable: if the process died.
        """
        try:
            with self._one_at_a_time:
                return self._process.call(order)
        except ProcessHangs:
            late = f"The photo could not be looked at within {_PATIENCE_S:g} s; save it anew as a plain JPEG."
            raise PhotoRefused(late) from None

    def stop(self) -> None:
        """End the process, if there is one. Calling it again does nothing."""
        self._process.stop()
