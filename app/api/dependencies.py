"""What request handlers reach for: the running parts of the service, and threads to wait in."""

from __future__ import annotations

import asyncio
import functools
import threading
import time
from collections import OrderedDict
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from contextlib import ExitStack
from typing import Annotated, Any, TypeVar

import numpy as np
from fastapi import Depends, Request
from pydantic import BaseModel
from starlette.requests import HTTPConnection

from osfcore.errors import OsfError
from osfcore.objects.asset_library import AssetLibrary
from osfcore.objects.catalogue import CATALOGUE

from ..processes.client import ProcessBusy, ProcessClient
from ..processes.predict_process import predictor_main
from ..processes.render_process import renderer_main
from ..services.disturber import Disturber
from ..services.driver import GRACE_S, Driver
from ..services.episodes import Episodes
from ..services.estimates import Estimates
from ..services.examples import OPENING, preset
from ..services.fields import FieldCatalogue
from ..services.goals import GoalChecks, Goals
from ..services.look_outlines import Outliner
from ..services.objects import OwnObjects, Thumbnails
from ..services.photos import BoardPhotos, PhotoTables, TablePhotos
from ..services.pushes import Predictions, Pushes
from ..services.robot import RobotTable
from ..services.runner import DemoScene, Runner
from ..services.service_settings import Settings
from ..storage.database import Store
from ..storage.photos import PhotoReader
from ..viewer import Viewer

Result = TypeVar("Result")
Source = TypeVar("Source")


class Lane:
    """Some threads, and a bound on how many may wait for one.

    Args:
        name: of the threads.
        threads: how many.
        waiting: how many calls may wait at once.
    """

    def __init__(self, name: str, threads: int, waiting: int) -> None:
        self._executor = ThreadPoolExecutor(threads, thread_name_prefix=name)
        self._places = threading.Semaphore(threads + waiting)

    async def run(self, function: Callable[..., Result], *arguments: Any, **named: Any) -> Result:  # noqa: ANN401
        """Call a function in a thread of this lane.

        Raises:
            ProcessBusy: if too many wait already.
        """
        if not self._places.acquire(blocking=False):
            raise ProcessBusy("service")
        future = self._executor.submit(function, *arguments, **named)
        future.add_done_callback(lambda _: self._places.release())  # not when the client leaves: the thread goes on
        return await asyncio.wrap_future(future)

    def close(self) -> None:
        """Take nothing more; threads end with what they do."""
        self._executor.shutdown(wait=False, cancel_futures=True)


def slow(handler: Callable[..., Result]) -> Callable[..., Any]:
    """Mark a route's handler, which takes `services`, as one that waits for a child process."""
    return _in_lane(handler, lambda services: services.slow_lane)


def urgent(handler: Callable[..., Result]) -> Callable[..., Any]:
    """Mark a route's handler, which takes `services`, as one that must be served whatever others do."""
    return _in_lane(handler, lambda services: services.urgent_lane)


def _in_lane(handler: Callable[..., Result], lane_of: Callable[[Services], Lane]) -> Callable[..., Any]:
    @functools.wraps(handler)
    async def handle(*, services: Services, **named: Any) -> Result:  # noqa: ANN401  the handler's own
        return await lane_of(services).run(handler, services=services, **named)

    return handle


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

    def of(self, source: Source, make: Callable[[Source], BaseModel]) -> str:
        """The JSON of what `make` returns, which was perhaps made for another stream just now.

        Args:
            source: frozen; what it is made of.
            make: called with it if it has not been made yet.
        """
        known = self._kept.get(id(source))
        if known is not None:
            return known[1]
        text = make(source).model_dump_json()
        with self._lock:
            self._kept[id(source)] = source, text  # holding the source keeps its identity from being used again
            if len(self._kept) > _KEPT:
                self._kept.popitem(last=False)
        return text


VISITOR_HEADER = "X-OSF-Visitor"
_READING = ("GET", "HEAD", "OPTIONS")
_FRESH_S = 1.0


class ObjectCatalogue:
    """The object library, looked through at most once a second."""

    def __init__(self, library: AssetLibrary) -> None:
        self._library = library
        self._lock = threading.Lock()
        self._seen_at = -_FRESH_S
        self._names: tuple[str, ...] = ()
        self._damaged: dict[str, str] = {}
        self._labels: dict[str, str] = {name: info.label for name, info in CATALOGUE.items()}

    def names(self) -> tuple[str, ...]:
        """Objects on this machine."""
        with self._lock:
            self._look()
            return self._names

    def damaged(self) -> dict[str, str]:
        """Return why other objects on this machine cannot be loaded, by name."""
        with self._lock:
            self._look()
            return self._damaged

    def _look(self) -> None:
        if time.monotonic() - self._seen_at > _FRESH_S:
            self._names, self._damaged = self._library.names(), self._library.damaged()
            self._seen_at = time.monotonic()
            for name in self._names:
                if name not in self._labels:
                    self._labels[name] = self._library.label(name)

    def outdate(self) -> None:
        """Look anew when next asked."""
        with self._lock:
            self._seen_at = -_FRESH_S
            self._labels = {name: info.label for name, info in CATALOGUE.items()}

    def labels(self) -> dict[str, str]:
        """Names for people, by name."""
        self.names()
        return self._labels


class Services:
    """The running parts of one app, between `start` and `stop`."""

    def __init__(self, settings: Settings) -> None:
        self.settings = settings
        self.event_texts = EventTexts()
        self.streams = threading.Semaphore(MAX_STREAMS)  # each event stream takes one while it lasts
        self.slow_lane = Lane("slow", threads=8, waiting=64)  # for what waits for a child process
        self.urgent_lane = Lane("urgent", threads=8, waiting=256)  # for what ends or holds work
        self.closing = threading.Event()  # event streams end when it is set
        self._stops = ExitStack()

    def start(self) -> None:
        """Start everything, which takes seconds."""
        settings, stack = self.settings, self._stops
        data_dir, opening = settings.data_dir, preset(OPENING)
        self.store = Store(data_dir, settings.max_stored_events)
        stack.callback(self.store.close)
        demo = DemoScene(opening.objects, opening.seed, opening.light)
        self.runner = Runner(settings, self.store, AssetLibrary(data_dir / "objects"), demo)
        stack.callback(self.runner.stop)
        self.runner.start()
        self.neural = ProcessClient(renderer_main, (data_dir,), "neural renderer")
        stack.callback(self.neural.stop)
        self.objects = ObjectCatalogue(self.runner.library)
        self.fields = FieldCatalogue(data_dir, self.objects.names)
        self.estimates = Estimates(self.runner, self.fields)
        stack.callback(self.estimates.stop)
        predictor = ProcessClient(predictor_main, (data_dir,), "predictor of pushes")
        stack.callback(predictor.stop)
        self.predictions = Predictions(self.runner.scenes, self.fields.names, predictor)
        self.pushes = Pushes(self.runner.scenes, self.predictions, self.runner.hub)
        reader = PhotoReader()
        stack.callback(reader.stop)
        self.goals = Goals(self.runner, data_dir, settings.max_goals, reader)
        self.goals.start()
        self.goal_checks = GoalChecks(self.runner.scenes, self.fields, self.goals, self.neural, self.objects.labels)
        self.photos = TablePhotos(self.runner, self.fields, data_dir, settings.max_photos)
        stack.callback(self.photos.stop)
        self.photos.start()
        self.photo_tables = PhotoTables(self.runner, self.photos, self.goals, self.neural)
        self.board_photos = BoardPhotos(self.photos.looker.ask)
        self.viewer = Viewer(self.runner, self.neural, self.fields.names, self.pushes, self.goals)
        stack.callback(self.viewer.stop)
        self.viewer.start()
        self.thumbnails = Thumbnails(self.runner.library, data_dir / "thumbnails")
        stack.callback(self.thumbnails.stop)
        self.robot = RobotTable(settings, self.runner, self.fields, self.goals)
        stack.callback(self.robot.close)
        self.robot.start()
        self.episodes = Episodes(self.runner, self.fields, self.goals, self.goal_checks)
        self.driver = Driver(self.runner.hub.publish, GRACE_S)
        self.own_objects = OwnObjects(self.runner)
        self.outliner = Outliner(self.runner.library)
        self.disturber = Disturber(self.runner.scenes, np.random.default_rng())
        stack.callback(self.urgent_lane.close)
        stack.callback(self.slow_lane.close)
        stack.callback(self.closing.set)

    def stop(self) -> None:
        """Stop what has been started, in the reverse order."""
        self._stops.close()

    def begin_closing(self) -> None:
        """End what would keep requests waiting: event streams, and thumbnails that are being drawn. Does not block."""
        self.closing.set()
        threading.Thread(target=self.thumbnails.stop, name="closing", daemon=True).start()


async def get_services(connection: HTTPConnection) -> Services:
    """The services of the app that handles a request or websocket."""
    return connection.app.state.services


async def only_the_driver(request: Request) -> None:
    """Let no page change anything but the one that drives; requests of programs do not say that they are of a page."""
    if request.method not in _READING:
        request.app.state.services.driver.check(request.headers.get(VISITOR_HEADER))


ServicesDep = Annotated[Services, Depends(get_services)]
