"""Threads for handlers that wait, in lanes: slow ones leave room for whoever wants to cancel or look.

Handlers without a mark share the threads of the framework (40). Those that wait for a child process would fill them all
once that process hangs, so they have a lane of their own, which refuses what it cannot take in.
"""

from __future__ import annotations

import asyncio
import functools
from collections.abc import Callable
from concurrent.futures import Future, ThreadPoolExecutor
from typing import Any, Protocol, TypeVar

from app.processes.process_client import ProcessBusy

Result = TypeVar("Result")
_SLOW_THREADS, _SLOW_WAITING = 8, 64
_URGENT_THREADS, _URGENT_WAITING = 8, 256


class Lane:
    """Some threads, and a bound on how many may wait for one.

    Args:
        name: of the threads.
        threads: how many.
        waiting: how many calls may wait at once.
    """

    def __init__(self, name: str, threads: int, waiting: int) -> None:
        self._executor = ThreadPoolExecutor(threads, thread_name_prefix=name)
        self._most = threads + waiting
        self._inside = 0  # touched by the event loop only

    async def run(self, function: Callable[..., Result], *arguments: Any, **named: Any) -> Result:  # noqa: ANN401
        """Call a function in a thread of this lane.

        Raises:
            ProcessBusy: if too many wait already.
        """
        if self._inside >= self._most:
            raise ProcessBusy("service")
        loop = asyncio.get_running_loop()
        future = self._executor.submit(functools.partial(function, *arguments, **named))
        self._inside += 1
        future.add_done_callback(functools.partial(self._leave, loop))  # not when the client leaves: the thread goes on
        return await asyncio.wrap_future(future)

    def close(self) -> None:
        """Take nothing more; threads end with what they do."""
        self._executor.shutdown(wait=False, cancel_futures=True)

    def _leave(self, loop: asyncio.AbstractEventLoop, _: Future[Any]) -> None:
        if not loop.is_closed():
            loop.call_soon_threadsafe(self._count_out)

    def _count_out(self) -> None:
        self._inside -= 1


class Lanes:
    """The lanes of one app: `slow` for what waits for a child process, `urgent` for what ends or holds work."""

    def __init__(self) -> None:
        self.slow = Lane("slow", _SLOW_THREADS, _SLOW_WAITING)
        self.urgent = Lane("urgent", _URGENT_THREADS, _URGENT_WAITING)

    def close(self) -> None:
        """Take nothing more."""
        self.slow.close()
        self.urgent.close()


class HasLanes(Protocol):
    """The services of an app, as far as lanes are concerned."""

    @property
    def lanes(self) -> Lanes:
        """The lanes of the app."""
        ...


def slow(handler: Callable[..., Result]) -> Callable[..., Any]:
    """Mark a route's handler, which takes `services`, as one that waits for a child process."""
    return _in_lane(handler, lambda lanes: lanes.slow)


def urgent(handler: Callable[..., Result]) -> Callable[..., Any]:
    """Mark a route's handler, which takes `services`, as one that must be served whatever others do."""
    return _in_lane(handler, lambda lanes: lanes.urgent)


def _in_lane(handler: Callable[..., Result], choose: Callable[[Lanes], Lane]) -> Callable[..., Any]:
    @functools.wraps(handler)
    async def handle(*, services: HasLanes, **named: Any) -> Result:  # noqa: ANN401  the handler's own
        return await choose(services.lanes).run(handler, services=services, **named)

    return handle
