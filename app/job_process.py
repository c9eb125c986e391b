"""A job process: runs the generator of one job, step by step, and listens for pause, resume and cancel."""

from __future__ import annotations

import contextlib
import dataclasses
import logging
import queue
import signal
import threading
import time
import zipfile
from collections.abc import Callable, Iterator
from multiprocessing.connection import Connection
from pathlib import Path
from typing import Any

from app.messages import (
    Act,
    AskStage,
    CancelJob,
    ChangeJob,
    Failure,
    JobCancelled,
    JobDone,
    JobRests,
    JobStep,
    ObserveScene,
    PauseJob,
    Reply,
    ResumeJob,
    StepJob,
    TakeView,
)
from app.processes import end_own_group, import_quietly, own_group, silence_stdout
from osfcore.errors import OsfError
from osfcore.objects.library import AssetLibrary

STEP_INTERVAL_S = 0.1  # steps that come faster are not told one by one
_log = logging.getLogger(__name__)


@dataclasses.dataclass(frozen=True, slots=True)
class Place:
    """Where a job reads and writes.

    Attributes:
        data_dir: of the service.
        folder: the job's own, for what it makes; exists.
        orders: what the service tells the job; set in the job's own process.
    """

    data_dir: Path
    folder: Path
    orders: Orders | None = None

    @property
    def library(self) -> AssetLibrary:
        """The objects on this machine."""
        return AssetLibrary(self.data_dir / "objects")


def _collect_pushes(params: dict[str, Any], place: Place) -> Iterator[Any]:
    from osfcore.world.collect_pushes import CollectPushes, collect_pushes

    yield from collect_pushes(CollectPushes(out=place.folder / "pushes.h5", **params), place.library)


def _collect_object(params: dict[str, Any], place: Place) -> Iterator[Any]:
    from osfcore.world.collect_images import CollectObject, collect_object

    out = place.folder / params["name"]
    yield from collect_object(CollectObject(out=out, **params), place.library)
    _pack(out)


def _collect_table(params: dict[str, Any], place: Place) -> Iterator[Any]:
    from osfcore.world.collect_images import CollectTable, collect_table

    out = place.folder / "table"
    yield from collect_table(CollectTable(out=out, **params))
    _pack(out)


def _fetch_assets(params: dict[str, Any], place: Place) -> Iterator[Any]:
    from osfcore.objects.fetch import fetch
    from osfcore.objects.sources import source_from

    source = source_from("pypi", place.data_dir / "downloads")
    yield from fetch(tuple(params["names"]), source, place.library)


def _train_field(params: dict[str, Any], place: Place) -> Iterator[Any]:
    from app.field_job import train_field_job

    yield from train_field_job(params, place)


def _estimate(params: dict[str, Any], place: Place) -> Iterator[Any]:
    from app.estimate_job import estimate_job

    yield from estimate_job(params, place)


def _episode(params: dict[str, Any], place: Place) -> Iterator[Any]:
    from app.episode.job import episode_job

    yield from episode_job(params, place)


KINDS: dict[str, Callable[[dict[str, Any], Place], Iterator[Any]]] = {
    "collect_pushes": _collect_pushes,
    "collect_object": _collect_object,
    "collect_table": _collect_table,
    "fetch_assets": _fetch_assets,
    "train_field": _train_field,
    "estimate": _estimate,
    "episode": _episode,
}
_WITHOUT_PHYSICS = ("fetch_assets", "train_field", "estimate")
_NOT_EXTRA = ("done", "total", "note", "seen")


def job_main(connection: Connection, kind: str, params: dict[str, Any], place: Place) -> None:
    """Run a job to its end and tell how it went."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)  # the web process decides when to stop
    own_group()
    silence_stdout()
    orders = Orders(connection, on_lost=end_own_group)
    if kind not in _WITHOUT_PHYSICS:
        import_quietly("osfcore.world.tabletop")
    with contextlib.suppress(OSError):  # the web process has gone
        connection.send(_run(connection, orders, kind, params, place))


def _run(connection: Connection, orders: Orders, kind: str, params: dict[str, Any], place: Place) -> object:
    result: dict[str, Any] = {}
    last = 0.0
    try:
        place = dataclasses.replace(place, orders=orders)
        with contextlib.closing(KINDS[kind](params, place)) as steps:  # pyright: ignore[reportArgumentType]
            for step in steps:
                result = _extras(step)
                now = time.monotonic()
                if now - last >= STEP_INTERVAL_S or step.done == step.total or getattr(step, "must_be_told", False):
                    connection.send(JobStep(step.done, step.total, step.note, result, getattr(step, "seen", None)))
                    last = now
                if getattr(step, "ends_round", False) and orders.rests_now():
                    connection.send(JobRests())
                if orders.must_stop():
                    return JobCancelled()
    except OsfError as error:
        return Failure.of(error)
    except MemoryError:
        return Failure(0, "OutOfMemory", "The job ran out of memory; take fewer or smaller images.")
    except Exception as error:
        _log.exception("a %s job failed", kind)
        return Failure(0, "Internal", f"The job failed ({type(error).__name__}); the service's log tells more.")
    return JobDone(result)


class Orders:
    """Listens on the pipe in a thread of its own, so that an order counts even during a long step."""

    def __init__(self, connection: Connection, on_lost: Callable[[], None]) -> None:
        self._connection = connection
        self._on_lost = on_lost
        self._may_run = threading.Event()
        self._may_run.set()
        self._is_cancelled = threading.Event()
        self._rests_after_round = threading.Event()
        self._answers: queue.SimpleQueue[Reply | Failure] = queue.SimpleQueue()
        self._changes: queue.SimpleQueue[dict[str, Any]] = queue.SimpleQueue()
        threading.Thread(target=self._listen, name="orders", daemon=True).start()

    def must_stop(self) -> bool:
        """Whether the job was cancelled; waits here while it is paused."""
        self._may_run.wait()
        return self._is_cancelled.is_set()

    def rests_now(self) -> bool:
        """Whether the job was to rest after a round; then it is paused from now on."""
        if not self._rests_after_round.is_set():
            return False
        self._rests_after_round.clear()
        self._may_run.clear()
        return True

    def changes(self) -> list[dict[str, Any]]:
        """Parameters that were sent since the last call, the latest last."""
        found = []
        with contextlib.suppress(queue.Empty):
            while True:
                found.append(self._changes.get_nowait())
        return found

    def ask(self, command: Act | ObserveScene | TakeView) -> Any:  # noqa: ANN401  each command says what answers it
        """Have something done with the scene that this job drives, and wait for the answer.

        Raises:
            StageError: if the stage refused it, or is not there.
        """
        from app.stage_link import StageError

        self._connection.send(AskStage(command))
        answer = self._answers.get()
        if isinstance(answer, Failure):
            raise StageError(answer.kind, answer.text)
        return answer.value

    def _listen(self) -> None:
        while True:
            try:
                order = self._connection.recv()
            except (EOFError, OSError):
                # The service died: nobody wants the result, and what is half-written counts as never begun.
                self._on_lost()
                return
            match order:
                case PauseJob():
                    self._may_run.clear()
                case ResumeJob():
                    self._rests_after_round.clear()
                    self._may_run.set()
                case StepJob():
                    self._rests_after_round.set()
                    self._may_run.set()
                case ChangeJob(params):
                    self._changes.put(params)
                case Reply() | Failure():
                    self._answers.put(order)
                case CancelJob():
                    self._is_cancelled.set()
                    self._may_run.set()


def _extras(step: object) -> dict[str, Any]:
    """What a step tells besides done, total, note and what the live view draws."""
    if not dataclasses.is_dataclass(step) or isinstance(step, type):
        return {}
    names = (field.name for field in dataclasses.fields(step))
    return {name: getattr(step, name) for name in names if name not in _NOT_EXTRA}


def _pack(folder: Path) -> None:
    """Put a folder into one ZIP beside it, for downloading; PNGs do not shrink, so they are only stored."""
    partial = folder.with_name(f".{folder.name}.zip")
    with zipfile.ZipFile(partial, "w", zipfile.ZIP_STORED) as archive:
        for path in sorted(folder.rglob("*")):
            archive.write(path, path.relative_to(folder.parent))
    partial.replace(folder.with_name(f"{folder.name}.zip"))
