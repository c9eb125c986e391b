"""The latest records of all scenes: kept in memory, written through to the store."""

from __future__ import annotations

import contextlib
import threading

from app.processes.messages.scene_messages import SceneRecord
from app.storage.database import CannotStore, Store
from osfcore.errors import UnknownName


class SceneTable:
    """Scenes by identifier, oldest first. Any thread may call; reading waits for nobody.

    Args:
        store: where they are kept.
    """

    def __init__(self, store: Store) -> None:
        self._store = store
        self._lock = threading.Lock()
        self._records: dict[str, SceneRecord] = {}
        self._unwritten: set[str] = set()  # scenes whose latest change is not stored
        self.current: str | None = None  # the scene that is shown

    def __len__(self) -> int:
        return len(self._records)

    def load(self) -> None:
        """Take over what the store holds."""
        records, self.current = self._store.scenes()
        self._records = {record.id: record for record in records}
        if self.current not in self._records:
            self.current = self.latest()

    def all(self) -> tuple[SceneRecord, ...]:
        """All scenes."""
        return tuple(self._records.values())

    def latest(self) -> str | None:
        """The newest scene, if there is one."""
        return next(reversed(self._records), None)

    def get(self, scene: str) -> SceneRecord:
        """One scene.

        Raises:
            UnknownName: if there is none.
        """
        record = self._records.get(scene)
        if record is None:
            raise UnknownName("scene", scene, tuple(self._records))
        return record

    def add(self, record: SceneRecord) -> None:
        """Keep a new scene.

        Raises:
            CannotStore: if the disk refuses; then it is not kept.
        """
        with self._lock:
            self._store.save_scene(record)
            self._records[record.id] = record

    def note(self, record: SceneRecord) -> None:
        """Take note of what a scene has become, without storing it yet; does nothing if it has gone."""
        with self._lock:
            if record.id in self._records:
                self._records[record.id] = record

    def save(self, scene: str) -> None:
        """Store a scene as it is now; does nothing if it has gone.

        Raises:
            CannotStore: if the disk refuses; then `write_again` tries it later.
        """
        with self._lock:
            record = self._records.get(scene)
            if record is not None:
                self._unwritten.add(scene)
                self._store.save_scene(record)
            self._unwritten.discard(scene)

    def write_again(self) -> None:
        """Store what could not be stored before, as far as the disk takes it now."""
        with contextlib.suppress(CannotStore):
            for scene in tuple(self._unwritten):
                self.save(scene)

    def remove(self, scene: str) -> None:
        """Forget a scene.

        Raises:
            CannotStore: if the disk refuses; then it stays.
        """
        with self._lock:
            self._store.delete_scene(scene)
            del self._records[scene]

    def show(self, scene: str | None) -> None:
        """Note which scene is shown."""
        self.current = scene
        with contextlib.suppress(CannotStore):  # then the next start may show another one
            self._store.set_current(scene)
