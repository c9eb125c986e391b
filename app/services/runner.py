"""The one command path: REST and viewer ask here for every change; scenes go to the simulation, jobs to `Jobs`."""

from __future__ import annotations

import contextlib
import logging
import math
import shutil
import threading
import time
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path

from osfcore.errors import InvalidInput, OsfError, UnknownName
from osfcore.geometry.light import Light
from osfcore.objects.asset_library import AssetLibrary, check_name

from ..jobs.job import Job, JobChanged, JobEvent
from ..jobs.kinds import KINDS, in_words
from ..jobs.kinds.episodes import EpisodeParams
from ..jobs.kinds.fields import TrainFieldParams
from ..jobs.params import JobParams
from ..jobs.process import JobProcess, Standby
from ..jobs.registry import Jobs
from ..storage.database import CannotStore, Store
from ..storage.field_files import Leftover, remove_workshop, sweep, workshops
from ..storage.usage import StorageMeter
from .event_hub import Hub, Notice
from .image_sets import ImageSets
from .scenes import DEMO_OBJECTS, Scenes
from .service_settings import Settings

_PROBE_S = 5.0  # between two tries whether the disk takes something
_STALE_S = 60.0  # after which the last try says nothing any more
RESERVED = ("table", "sets")  # the table's own field, and a path of the REST interface
_log = logging.getLogger(__name__)


class TrainingAlready(OsfError):
    """A second order for a field that is being trained."""

    def __init__(self, name: str) -> None:
        super().__init__(f"A field of {name} is being trained already; wait for it, cancel it or take another name.")


class SetInUse(OsfError):
    """An image set that a job needs."""

    def __init__(self, job: Job) -> None:
        name = TrainFieldParams.from_json(job.params).name
        super().__init__(f"A training of {name} needs these images; wait for it or cancel it first.")


class SceneNeeded(OsfError):
    """A scene that a job needs to go on, or to begin."""

    def __init__(self, job: Job) -> None:
        super().__init__(f"This table is needed by the {in_words(job)} that is {job.state}; cancel that first.")


class WorkshopInUse(OsfError):
    """Files of a training that goes on, or waits."""

    def __init__(self, name: str, job: Job) -> None:
        super().__init__(f"The training of {name} that is {job.state} needs these files; cancel it first.")


@dataclass(frozen=True, eq=False, slots=True)
class DemoScene:
    """The first scene of a new service.

    Attributes:
        names: of its objects.
        seed: of where they lie.
        light: on it.
    """

    names: tuple[str, ...]
    seed: int
    light: Light


class Runner:
    """Scenes, jobs and their events.

    Methods that wait for the simulation block; those that only read answer from memory. Any thread may call them.

    Args:
        settings: of the service.
        store: keeps scenes and jobs.
        library: meshes of the objects.
        demo: the first scene, if its objects are there; else it is a random one.
    """

    def __init__(self, settings: Settings, store: Store, library: AssetLibrary, demo: DemoScene | None = None) -> None:
        self._settings, self._store, self._demo = settings, store, demo
        self.library, self.hub = library, Hub()
        self.scenes = Scenes(settings, store, library, self.hub, self.holder)
        self._standby = Standby() if settings.standby else None
        self.jobs = Jobs(
            store,
            settings.data_dir,
            self._on_job,
            settings.max_queued_jobs,
            settings.cancel_grace_s,
            self.scenes.serve,
            start_process=JobProcess if self._standby is None else self._standby.process,
        )
        self.storage = StorageMeter(settings.data_dir, settings.max_data_bytes, settings.min_free_bytes)
        self.sets = ImageSets(settings.data_dir / "sets", settings.max_image_sets, self.storage.check_room)
        self._ordering = threading.Lock()  # what was checked for a job still holds when it is queued
        self._demo_due = settings.demo_scene
        self._started = time.monotonic()
        self._probed_at, self._refusal = -math.inf, None
        self._probing: threading.Thread | None = None

    def start(self) -> None:
        """Take over what the store holds, start simulation and jobs, make a first scene if there is none."""
        self.sets.start()
        for folder in ("fields", "training"):
            sweep(self._settings.data_dir / folder)
        self.scenes.start()
        self.jobs.start()
        if self._standby is not None:
            self._standby.prepare()
        for entry in self._store.set_aside:
            _log.warning(entry.sentence)
            self.hub.publish(Notice("warning", entry.sentence))
        self.ensure_demo_scene()

    def stop(self) -> None:
        """End all processes. Calling it again does nothing."""
        self.sets.stop()
        if self._probing is not None:
            self._probing.join()
        self.jobs.stop()
        if self._standby is not None:
            self._standby.stop()
        self.scenes.stop()
        self.storage.stop()

    def holder(self, scene: str) -> str | None:
        """What drives a scene, in words, if a job does: then only that job may change it."""
        job = self.jobs.holder(scene)
        return None if job is None else in_words(job)

    @property
    def unwritten(self) -> int:
        """How many scenes and jobs have changed in ways that the disk has refused so far."""
        return self._store.unwritten

    def storing_problem(self) -> str | None:
        """Why something is not stored, for people; None if all is. Tries to write now and then."""
        age_s = time.monotonic() - self._probed_at
        if age_s > _PROBE_S:
            self._probed_at = time.monotonic()
            # A disk may take long, and whoever asks often need not wait for it.
            self._probing = threading.Thread(target=self._probe, name="probe of the disk", daemon=True)
            self._probing.start()
            if age_s > _STALE_S:
                self._probing.join()
        if self.unwritten:
            changed = "one scene or job" if self.unwritten == 1 else f"{self.unwritten} scenes and jobs"
            waits = f"What has become of {changed} could not be stored; it is tried again."
            return waits if self._refusal is None else f"{waits} {self._refusal}"
        return self._refusal

    def _probe(self) -> None:
        self._refusal = self._store.probe()

    @property
    def uptime_s(self) -> float:
        """Time since the service was made [s]."""
        return time.monotonic() - self._started

    def submit_job(self, kind: str, params: JobParams) -> Job:
        """Queue a job.

        Raises:
            StorageFull: if nothing more may be written.
            OsfError: if it could not succeed, or too many wait.
        """
        self.storage.check_room()
        with self._ordering:
            if isinstance(params, TrainFieldParams):
                self._check_training(params)
            known = self.library.info if kind == "fetch_assets" else self.library.check
            KINDS[kind].check(params, known, len(self.library.names()))
            return self.jobs.submit(kind, params.to_json())

    def submit_with_inputs(self, kind: str, params: JobParams, inputs: Path) -> Job:
        """Queue a job that was given files.

        Args:
            kind: what to do.
            params: with what, and perhaps the scene that it drives.
            inputs: see `Jobs.submit`.

        Raises:
            StorageFull: if nothing more may be written.
            UnknownName: if the scene has gone meanwhile.
            QueueFull: if too many wait.
        """
        self.storage.check_room()
        with self._ordering:
            if isinstance(params, EpisodeParams):
                self.scenes.get(params.scene)
            return self.jobs.submit(kind, params.to_json(), inputs)

    def forget_job(self, job: str) -> None:
        """Remove a finished job for good, with all its files, see `Jobs.forget`."""
        self.jobs.forget(job)
        self.storage.outdate()

    def delete_scene(self, scene: str) -> None:
        """Forget a scene; if it was shown, the latest other one is shown.

        Raises:
            UnknownName: if there is none.
            SceneNeeded: if a job that waits, runs or pauses drives it.
        """
        with self._ordering:
            if (job := self.jobs.needs(scene)) is not None:
                raise SceneNeeded(job)
            self.scenes.delete(scene)

    def leftovers(self) -> tuple[Leftover, ...]:
        """What trainings have left that did not finish, or have made so far, sorted by name."""
        return workshops(self._settings.data_dir)

    def remove_leftover(self, name: str) -> None:
        """Delete what a training has left; the same order then begins anew.

        Raises:
            UnknownName: if it has left nothing.
            WorkshopInUse: if a training that goes on or waits needs it.
            CannotWrite: if that is not allowed.
        """
        with self._ordering:
            names = [left.name for left in self.leftovers()]
            if name not in names:
                raise UnknownName("training", name[:80], names)
            for job in self.jobs.live("train_field"):
                if TrainFieldParams.from_json(job.params).name == name:
                    raise WorkshopInUse(name, job)
            remove_workshop(self._settings.data_dir, name)
        self.storage.outdate()

    def remove_set(self, set_id: str) -> None:
        """Delete an uploaded image set, damaged or not.

        Raises:
            UnknownName: if there is none.
            SetInUse: if a job needs it.
        """
        with self._ordering:
            for job in self.jobs.live("train_field"):
                if TrainFieldParams.from_json(job.params).source.set == set_id:
                    raise SetInUse(job)
            self.sets.remove(set_id)
        self.storage.outdate()

    def ensure_demo_scene(self) -> None:
        """Make the first scene as soon as there are objects, in the background; does nothing if there is a scene."""
        with self._ordering:
            count = min(DEMO_OBJECTS, len(self.library.names()))
            if not self._demo_due or self.scenes.all() or count == 0:
                return
            self._demo_due = False
        threading.Thread(target=self._make_demo_scene, args=(count,), name="demo-scene", daemon=True).start()

    def _make_demo_scene(self, count: int) -> None:
        try:
            if self._demo is not None and all(map(self.library.has, self._demo.names)):
                self.scenes.create(names=self._demo.names, seed=self._demo.seed, light=self._demo.light)
            else:
                self.scenes.create(count=count, seed=0)
        except OsfError as error:
            self.hub.publish(Notice("warning", f"No first scene could be made. {error}"))

    # Inside

    def _check_training(self, params: TrainFieldParams) -> None:
        name, source = check_name(params.name), params.source
        if name in RESERVED:
            raise InvalidInput("object name", repr(name), "another one; this one is taken")
        if source.mesh is not None:
            self.library.check(source.mesh)
        elif source.set is not None:
            self.sets.get(source.set)
        for job in self.jobs.live("train_field"):
            if TrainFieldParams.from_json(job.params).name == name:
                raise TrainingAlready(name)

    def _on_job(self, event: JobEvent) -> None:
        self.hub.publish(event)
        if not isinstance(event, JobChanged):
            return
        job, scene = event.job, event.job.scene
        if job.kind in ("fetch_assets", "add_object") and job.state == "done":
            self.ensure_demo_scene()
        if job.kind == "episode" and job.is_finished and scene is not None and self.jobs.needs(scene) is None:
            # In the background: the jobs' thread must not wait for the simulation.
            threading.Thread(target=self._undo_disturbances, args=(scene,), daemon=True).start()

    def _undo_disturbances(self, scene: str) -> None:
        """What was done to fool an episode ends with it, or the next one would begin in the dark."""
        with contextlib.suppress(OsfError):  # the scene may be gone, and the simulation just starting again
            self.scenes.undo_disturbances(scene)


def fill_inputs(folder: Path, files: Mapping[str, Path]) -> None:
    """Make a folder of inputs for a job, with copies of files.

    Args:
        folder: from `Jobs.new_inputs`.
        files: what is copied, by its name in the folder.

    Raises:
        CannotStore: if the disk refuses.
    """
    try:
        folder.mkdir(parents=True)
        for name, file in files.items():
            shutil.copyfile(file, folder / name)
    except OSError as error:
        raise CannotStore(folder, error.strerror or str(error)) from error
