"""Training of several fields, here or by any `concurrent.futures.Executor`.

The calling process writes weights and metrics, because workers may be on other machines that share only the image sets.
If a worker dies, its object is trained again: by the executor if it can (Dask's does), or by the next run. The next run
skips finished fields; their metrics hold the settings that they were made with.
"""

from __future__ import annotations

import hashlib
import json
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import FIRST_COMPLETED, Executor, Future, wait
from concurrent.futures.process import BrokenProcessPool
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

from osfcore.errors import OsfError, WorkerDied
from osfcore.fields.devices import computing_threads
from osfcore.fields.train_osf import FieldSettings, FieldStep
from osfcore.io.files import write_atomically, write_json
from osfcore.io.image_set import read_splits
from osfcore.progress import Progress

_MADE_OF = "made_of"  # key of the metrics by which a finished training is known
TrainOne = Callable[[Any], Iterator[FieldStep]]


@dataclass(frozen=True, slots=True)
class _Training:
    settings: FieldSettings
    made_of: dict[str, Any]

    @property
    def name(self) -> str:
        return self.settings.out.stem

    def record(self, weights: bytes) -> dict[str, Any]:
        return {**self.made_of, "weights_sha256": hashlib.sha256(weights).hexdigest()}

    def is_finished(self) -> bool:
        try:
            weights, metrics = _read(self.settings.out)
        except (OSError, ValueError):
            return False
        return metrics.get(_MADE_OF) == self.record(weights)

    def keep(self, weights: bytes, metrics: dict[str, Any]) -> None:
        write_atomically(self.settings.out, weights)
        write_json(self.settings.out.with_suffix(".json"), {**metrics, _MADE_OF: self.record(weights)})


def train_several(
    settings: Sequence[FieldSettings],
    train: TrainOne,
    executor: Executor | None = None,
    *,
    threads: int = 1,
    shares_disk: bool = True,
) -> Iterator[Progress]:
    """Train fields, and write each once it is done. Fields that an earlier run finished the same way are kept.

    Args:
        settings: settings of each training, with different outputs.
        train: training function, such as `train_field`, which executors must be able to pickle.
        executor: pool that trains several fields at once; None to train one after the other in this process, with all
            its threads.
        threads: threads of each training by the executor.
        shares_disk: whether the executor's workers can write to the outputs. Checkpoints then lie beside the outputs,
            so that a training continues after its worker died.

    Yields:
        Number of finished objects; in this process also the seconds (or steps) of the present one.

    Raises:
        InvalidInput: if settings are out of range. This is checked before any training.
        CorruptFile: if an image set is damaged, which is checked before any training, or if nothing could be learned
            from it. An executor raises the latter once the others are done.
        CannotWrite: if an output cannot be written, which is checked first.
        WorkerDied: if a worker process died. Finished fields are kept.
    """
    missing = []
    for one in settings:
        yield Progress(0, len(settings), f"Reading the images of {one.out.stem}")
        next(train(replace(one, device="cpu")))  # refuses what cannot work; of devices, the worker knows
        # Plain JSON of everything that a field depends on, without the paths of image set and output.
        plain = {key: value for key, value in asdict(one).items() if key not in ("data", "out")}
        images = [images.digest() for images in read_splits(one.data)]
        training = _Training(one, {"settings": plain, "images": images})
        if not training.is_finished():
            missing.append(training)
    done, total = len(settings) - len(missing), len(settings)
    yield Progress(done, total, f"{done} of {total} trained")
    if executor is None:
        for number, training in enumerate(missing, start=done):
            for step in train(training.settings):
                own = step.progress
                yield Progress(number * own.total + own.done, total * own.total, f"{training.name}: {own.note}")
            training.keep(*_read(training.settings.out))
        return
    for trained, last in enumerate(_side_by_side(missing, train, executor, threads, shares_disk), start=done + 1):
        yield Progress(trained, total, f"{trained} of {total} trained, {last}")


def _read(out: Path) -> tuple[bytes, dict[str, Any]]:
    """Read weights and metrics of a training."""
    return out.read_bytes(), json.loads(out.with_suffix(".json").read_text(encoding="utf-8"))


def _side_by_side(
    missing: Sequence[_Training], train: TrainOne, executor: Executor, threads: int, shares_disk: bool
) -> Iterator[str]:
    """Yield a note about the result each time an object is finished and written."""
    running: dict[Future[tuple[bytes, dict[str, Any]]], _Training] = {}
    failed: list[OsfError] = []
    try:
        for training in missing:
            settings = replace(training.settings, data=training.settings.data.absolute())
            running[executor.submit(_trained, settings, train, threads, shares_disk)] = training
        while running:
            finished, _ = wait(running, return_when=FIRST_COMPLETED)
            for future in finished:
                training = running.pop(future)
                if isinstance(error := future.exception(), OsfError):  # hours of the others shall not be lost
                    failed.append(error)
                    continue
                weights, metrics = future.result()
                training.keep(weights, metrics)
                yield f"{training.name} with {metrics['psnr_full']:.1f} dB held out"
    except BrokenProcessPool as error:
        raise WorkerDied("training a field") from error
    finally:
        for future in running:
            future.cancel()
    if failed:
        raise failed[0]


def _trained(settings: FieldSettings, train: TrainOne, threads: int, shares_disk: bool) -> tuple[bytes, dict[str, Any]]:
    """Train in a worker, beside the output if that is within reach; return weights and metrics."""
    with TemporaryDirectory() as folder, computing_threads(threads):
        settings = settings if shares_disk else replace(settings, out=Path(folder) / settings.out.name)
        for _ in train(settings):
            pass
        return _read(settings.out)
