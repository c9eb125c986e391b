"""What event streams share: the JSON of the latest events, made once for all of them, and a bound on their number."""

from __future__ import annotations

import threading
from collections import OrderedDict
from collections.abc import Callable, Iterator
from contextlib import contextmanager

from pydantic import BaseModel

from osfcore.errors import OsfError

MAX_STREAMS = 100
_KEPT = 32


class TooManyStreams(OsfError):
    """More pages follow the service than it can serve."""

    def __init__(self) -> None:
        super().__init__(f"{MAX_STREAMS} pages and programs follow this service already, which is the most; close one.")


class EventTexts:
    """The JSON of events. Any thread may call."""

    def __init__(self) -> None:
        self._lock = threading.Lock()
        self._kept: OrderedDict[int, tuple[object, str]] = OrderedDict()
        self._streams = 0

    def of(self, source: object, make: Callable[[], BaseModel]) -> str:
        """The JSON of what `make` returns, which was perhaps made for another stream just now.

        Args:
            source: frozen; what it is made of.
            make: called if it has not been made yet.
        """
        known = self._kept.get(id(source))
        if known is not None:
            return known[1]
        text = make().model_dump_json()
        with self._lock:
            self._kept[id(source)] = source, text  # holding the source keeps its identity from being used again
            if len(self._kept) > _KEPT:
                self._kept.popitem(last=False)
        return text

    @contextmanager
    def stream(self) -> Iterator[None]:
        """Count one stream.

        Raises:
            TooManyStreams: if there are too many.
        """
        if self._streams >= MAX_STREAMS:
            raise TooManyStreams
        self._streams += 1
        try:
            yield
        finally:
            self._streams -= 1
