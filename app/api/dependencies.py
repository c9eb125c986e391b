"""What request handlers reach for, in one object on the app."""

from __future__ import annotations

import threading
import time
from dataclasses import dataclass, field
from typing import Annotated

from fastapi import Depends, Request
from starlette.requests import HTTPConnection

from app.api.event_texts import EventTexts
from app.api.lanes import Lanes
from app.api.schemas.common import SceneOut
from app.processes.messages.scene_messages import SceneRecord
from app.processes.process_client import ProcessClient
from app.services.disturber import Disturber
from app.services.episodes import Episodes
from app.services.estimates import Estimates
from app.services.fields import FieldCatalogue
from app.services.goals.goal_checks import GoalChecks
from app.services.goals.goals import Goals
from app.services.objects.own_objects import OwnObjects
from app.services.objects.thumbnails import Thumbnails
from app.services.photos.board_photos import BoardPhotos
from app.services.photos.photo_tables import PhotoTables
from app.services.photos.table_photos import TablePhotos
from app.services.predictions import Predictions
from app.services.robots.robot_table import RobotTable
from app.services.runner import Runner
from app.services.service_settings import Settings
from app.services.visitors.driver import Driver
from app.services.visitors.look_outlines import Outliner
from app.storage.database import Store
from app.viewer import Viewer
from osfcore.objects.asset_library import AssetLibrary
from osfcore.objects.catalogue import CATALOGUE

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
        self._labels: dict[str, str] = {name: info.label for name, info in CATALOGUE.items()}

    def names(self) -> tuple[str, ...]:
        """Objects on this machine."""
        with self._lock:
            if time.monotonic() - self._seen_at > _FRESH_S:
                self._names, self._seen_at = self._library.names(), time.monotonic()
                for name in self._names:
                    if name not in self._labels:
                        self._labels[name] = self._library.label(name)
            return self._names

    def outdate(self) -> None:
        """Look anew when next asked."""
        with self._lock:
            self._seen_at = -_FRESH_S
            self._labels = {name: info.label for name, info in CATALOGUE.items()}

    def labels(self) -> dict[str, str]:
        """Names for people, by name."""
        self.names()
        return self._labels


@dataclass(frozen=True)
class Services:
    """The running parts of one app."""

    settings: Settings
    store: Store
    runner: Runner
    viewer: Viewer
    objects: ObjectCatalogue
    fields: FieldCatalogue
    neural: ProcessClient
    estimates: Estimates
    predictions: Predictions
    goals: Goals
    goal_checks: GoalChecks
    photos: TablePhotos
    photo_tables: PhotoTables
    board_photos: BoardPhotos
    episodes: Episodes
    driver: Driver
    own_objects: OwnObjects
    thumbnails: Thumbnails
    outliner: Outliner
    disturber: Disturber
    robot: RobotTable
    event_texts: EventTexts = field(default_factory=EventTexts)
    lanes: Lanes = field(default_factory=Lanes)
    closing: threading.Event = field(default_factory=threading.Event)  # event streams end when it is set

    def begin_closing(self) -> None:
        """End what would keep requests waiting: event streams, and thumbnails that are being drawn. Does not block."""
        self.closing.set()
        threading.Thread(target=self.thumbnails.stop, name="closing", daemon=True).start()

    def scene_out(self, record: SceneRecord) -> SceneOut:
        """A scene as JSON."""
        return SceneOut.of(record, self.objects.labels(), is_current=record.id == self.runner.current)


async def get_services(connection: HTTPConnection) -> Services:
    """The services of the app that handles a request or websocket."""
    return connection.app.state.services


async def only_the_driver(request: Request) -> None:
    """Let no page change anything but the one that drives; requests of programs do not say that they are of a page."""
    if request.method not in _READING:
        request.app.state.services.driver.check(request.headers.get(VISITOR_HEADER))


ServicesDep = Annotated[Services, Depends(get_services)]
