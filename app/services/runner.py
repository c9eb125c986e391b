"""The one command path: REST and viewer ask here for every change; scenes go to the simulation, jobs to `Jobs`."""

from __future__ import annotations

import logging
import threading
import time
from typing import Any

from app.jobs.job import Job, JobChanged, JobEvent, SetInUse, TrainingAlready, check_params
from app.jobs.registry import Jobs
from app.processes.messages.scene_messages import Act, Command
from app.services.event_hub import Notice
from app.services.image_sets import ImageSets
from app.services.scenes import DEMO_OBJECTS, Scenes
from app.services.service_settings import Settings
from app.storage.database import Store
from app.storage.field_files import sweep
from osfcore.errors import InvalidInput, OsfError
from osfcore.objects.asset_library import AssetLibrary, check_name

_RESERVED = ("table", "sets")  # the table's own field, and a path of the REST interface
_log = logging.getLogger(__name__)


class Runner(Scenes):
    """Scenes, jobs and their events.

    Methods that wait for the simulation block; those that only read answer from memory. Any thread may call them.
    """

    def __init__(self, settings: Settings, store: Store, library: AssetLibrary) -> None:
        super().__init__(settings, store, library)
        self.jobs = Jobs(
            store, settings.data_dir, self._on_job, settings.max_queued_jobs, settings.cancel_grace_s, self._serve
        )
        self.sets = ImageSets(settings.data_dir / "sets", settings.max_image_sets)
        self._ordering = threading.Lock()  # what was checked for a job still holds when it is queued
        self._demo_due = settings.demo_scene
        self._started = time.monotonic()

    def start(self) -> None:
        """Take over what the store holds, start simulation and jobs, make a first scene if there is none."""
        self.sets.start()
        sweep(self._settings.data_dir / "fields")
        super().start()
        self.jobs.start()
        self.ensure_demo_scene()

    def stop(self) -> None:
        """End all processes. Calling it again does nothing."""
        self.sets.stop()
        self.jobs.stop()
        super().stop()

    def holder(self, scene: str) -> str | None:
        """The job that drives a scene, if one does: then only that job may change it."""
        return self.jobs.holder(scene)

    @property
    def uptime_s(self) -> float:
        """Time since the service was made [s]."""
        return time.monotonic() - self._started

    def submit_job(self, kind: str, params: dict[str, Any]) -> Job:
        """Queue a job.

        Raises:
            OsfError: if it could not succeed, or too many wait.
        """
        fetches = kind == "fetch_assets"
        with self._ordering:
            if kind == "train_field":
                self._check_training(params)
            check_params(kind, params, self.library.info if fetches else self._check_object, len(self.library.names()))
            return self.jobs.submit(kind, params)

    def remove_set(self, set_id: str) -> None:
        """Delete an uploaded image set.

        Raises:
            UnknownName: if there is none.
            SetInUse: if a job needs it.
        """
        with self._ordering:
            self.sets.get(set_id)
            for job in self.jobs.live("train_field"):
                if job.params["source"]["set"] == set_id:
                    raise SetInUse(set_id, job.id)
            self.sets.remove(set_id)

    def ensure_demo_scene(self) -> None:
        """Make the first scene as soon as there are objects, in the background; does nothing if there is a scene."""
        with self._lock:
            count = min(DEMO_OBJECTS, len(self.library.names()))
            if not self._demo_due or self._records or count == 0:
                return
            self._demo_due = False
        threading.Thread(target=self._make_demo_scene, args=(count,), name="demo-scene", daemon=True).start()

    def _make_demo_scene(self, count: int) -> None:
        try:
            self.create_scene(count=count, seed=0)
        except OsfError as error:
            self.hub.publish(Notice("warning", f"No first scene could be made. {error}"))

    # Inside

    def _serve(self, command: Command) -> Any:  # noqa: ANN401  each command says what answers it
        """Carry out what a job asks for with its own scene."""
        return self._change(command) if isinstance(command, Act) else self._simulation.call(command)

    def _check_training(self, params: dict[str, Any]) -> None:
        name, source = check_name(params["name"]), params["source"]
        if name in _RESERVED:
            raise InvalidInput("object name", repr(name), "another one; this one is taken")
        if source["mesh"] is not None:
            self._check_object(source["mesh"])
        else:
            self.sets.get(source["set"])
        for job in self.jobs.live("train_field"):
            if job.params["name"] == name:
                raise TrainingAlready(name, job.id)

    def _on_job(self, event: JobEvent) -> None:
        self.hub.publish(event)
        if isinstance(event, JobChanged) and event.job.kind == "fetch_assets" and event.job.state == "done":
            self.ensure_demo_scene()
