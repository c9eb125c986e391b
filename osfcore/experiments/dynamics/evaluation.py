"""How good predictions of pushes are: open loop over episodes that nothing was trained on.

Episodes of both policies with two, three, four and six objects are collected once into the output folder, from random
streams that no other collection uses. Windows of up to 30 actions are rolled out by the network, by a quasi-static
model and by nobody (everything stays), and scored for objects that truly moved. Pairs of objects that never meet in
training are scored apart, and so are objects that a second network has never seen; with the paper's network neither is,
for it has met them all. Episodes are the same for every method.
"""

from __future__ import annotations

import hashlib
from collections.abc import Iterator, Mapping
from concurrent.futures import Executor
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from osfcore.dynamics.network_weights import read_metrics, read_network, shipped
from osfcore.dynamics.push_models import load_shapes
from osfcore.dynamics.shapes.object_shapes import ObjectShape
from osfcore.errors import InvalidInput, MissingAssets, check_seed
from osfcore.experiments.benchmarks.rollouts import BENCH_NAMES, rollout_rate
from osfcore.experiments.dynamics.methods import DynamicsMethod, Predictor, check_method, load_predictor
from osfcore.experiments.dynamics.plots import write_gallery, write_plots
from osfcore.experiments.dynamics.report import DynamicsReport, Scored, report_json
from osfcore.experiments.dynamics.scores import analytic, constant, errors, learned, windows_of
from osfcore.fields.field_library import FieldLibrary
from osfcore.io.files import write_json
from osfcore.io.push_file import read_pushes
from osfcore.objects.asset_library import AssetLibrary
from osfcore.random_streams import Stream, stream_seed
from osfcore.world.collection.collect_pushes import CollectPushes, collect_pushes

REPORT_FILE = "dynamics.json"
MAX_TASKS = 10_000
COUNTS = (2, 3, 4, 6)  # objects in a scene
_STEPS = 50
_OTHERS = 2  # objects beside unseen ones
_UNSEEN = "unseen"


@dataclass(frozen=True, slots=True)
class EvaluateDynamics:
    """What to measure.

    Attributes:
        folder: for episodes, pictures and dynamics.json; those of the paper's method go into its folder "paper".
        tasks: episodes of each policy with three objects, and of both together with other numbers.
        seed: of the episodes.
        names: objects; all that have a field and a mesh if None.
        data_dir: where a network trained on this machine may be.
        method: whose predictions.
    """

    folder: Path
    tasks: int = 20
    seed: int = 0
    names: tuple[str, ...] | None = None
    data_dir: Path | None = None
    method: DynamicsMethod = "ours"

    @property
    def results(self) -> Path:
        """Folder for pictures and dynamics.json."""
        return self.folder if self.method == "ours" else self.folder / self.method


@dataclass(frozen=True, eq=False, slots=True)
class DynamicsEvaluationStep:
    """How far an evaluation is.

    Attributes:
        done: parts finished.
        total: parts in all.
        note: what is being done.
        report: with the last step only.
    """

    done: int
    total: int
    note: str
    report: dict[str, Any] | None = None


@dataclass(frozen=True, slots=True)
class _Set:
    """Episodes of one kind."""

    key: str
    policy: str
    objects: int
    episodes: int
    names: tuple[str, ...]


def evaluate_dynamics(
    config: EvaluateDynamics, fields: FieldLibrary, assets: AssetLibrary, executor: Executor | None = None
) -> Iterator[DynamicsEvaluationStep]:
    """Collect, predict and score; pictures and dynamics.json go to `config.results`.

    Args:
        config: what to measure.
        fields: shapes come from them.
        assets: meshes for the simulator.
        executor: simulates episodes side by side, if given.

    Raises:
        UnknownName, MissingAssets: if an object lacks a field or a mesh.
        InvalidInput: if a number is out of range.
        CorruptFile, CannotWrite: as files are.
    """
    names = _checked(config, fields, assets)
    unseen = _unseen(config, names)
    sets = _sets(config, names, unseen)
    total = 2 * len(sets) + 1
    done = 0
    for entry in sets:
        for step in _collect(config, entry, assets, executor):
            yield DynamicsEvaluationStep(done, total, f"Pushes, {entry.objects} objects: {step}")
        done += 1
    shapes = load_shapes(config.data_dir, fields, names)
    predictor = load_predictor(config.method, config.data_dir, fields, shapes)
    scored: dict[str, Scored] = {}
    for entry in sets:
        yield DynamicsEvaluationStep(done, total, f"Predicting {entry.policy} pushes of {entry.objects} objects")
        scored[entry.key] = _score(config, entry, shapes, assets, predictor)
        done += 1
    yield DynamicsEvaluationStep(done, total, "Timing rollouts")
    bench_shapes = load_shapes(config.data_dir, fields, BENCH_NAMES)
    timed = load_predictor(config.method, config.data_dir, fields, bench_shapes).model
    report = DynamicsReport(
        by_set={key: value for key, value in scored.items() if key != _UNSEEN},
        unseen=scored.get(_UNSEEN),
        unseen_names=unseen,
        rollout_steps_per_s=rollout_rate(timed, bench_shapes),
        holds_out_pairs=config.method == "ours",
    )
    write_plots(config.results, report)
    write_gallery(config.results, report, shapes)
    figures = report_json(report)
    write_json(config.results / REPORT_FILE, figures)
    yield DynamicsEvaluationStep(total, total, "Everything is measured", figures)


def _checked(config: EvaluateDynamics, fields: FieldLibrary, assets: AssetLibrary) -> tuple[str, ...]:
    """The objects; at least as many as the largest scene of three policies needs."""
    if not 1 <= config.tasks <= MAX_TASKS:
        raise InvalidInput("number of tasks", config.tasks, f"between 1 and {MAX_TASKS}")
    check_seed(config.seed)
    check_method(config.method)
    if config.names is None:
        names = tuple(name for name in fields.names() if assets.has(name))
    else:
        for name in config.names:
            fields.info(name)
            if not assets.has(name):
                raise MissingAssets([name])
        names = tuple(sorted(set(config.names)))
    if len(names) < min(COUNTS) + 1:
        raise InvalidInput("number of objects with a field and a mesh", len(names), f"at least {min(COUNTS) + 1}")
    return names


def _unseen(config: EvaluateDynamics, names: tuple[str, ...]) -> tuple[str, ...]:
    """Objects that the second shipped network has not seen, as far as they are there; the paper's has no second one."""
    if config.method != "ours":
        return ()
    return tuple(name for name in read_metrics(shipped("pushes_without_two")).get("without", ()) if name in names)


def _sets(config: EvaluateDynamics, names: tuple[str, ...], unseen: tuple[str, ...]) -> list[_Set]:
    sets = []
    for objects in (count for count in COUNTS if count <= len(names)):
        share = config.tasks if objects == 3 else -(-config.tasks // 2)
        sets += [_Set(f"{policy} {objects}", policy, objects, share, names) for policy in ("directed", "paper")]
    if unseen:
        others = tuple(name for name in names if name not in unseen)[:: max(len(names) // _OTHERS, 1)][:_OTHERS]
        sets.append(_Set(_UNSEEN, "directed", 3, config.tasks, tuple(sorted((*unseen, *others)))))
    return sets


def _collect(config: EvaluateDynamics, entry: _Set, assets: AssetLibrary, executor: Executor | None) -> Iterator[str]:
    path = _path(config, entry)
    if path.exists():
        return
    seed = stream_seed(config.seed, Stream.HELD_OUT_PUSHES, entry.objects, int(entry.policy == "paper"))
    collection = CollectPushes(path, entry.episodes, _STEPS, entry.objects, entry.policy, seed, names=entry.names)  # pyright: ignore[reportArgumentType]
    for step in collect_pushes(collection, assets, executor):
        yield step.note


def _path(config: EvaluateDynamics, entry: _Set) -> Path:
    """Where the episodes of a set are kept; the name tells all that they depend on, but for the simulator."""
    which = hashlib.sha256(" ".join(entry.names).encode()).hexdigest()[:8]
    return config.folder / f"pushes-{entry.key.replace(' ', '-')}-{entry.episodes}-{config.seed}-{which}.h5"


def _score(
    config: EvaluateDynamics, entry: _Set, shapes: Mapping[str, ObjectShape], assets: AssetLibrary, predictor: Predictor
) -> Scored:
    windows = windows_of(read_pushes(_path(config, entry)))
    symmetries = {name: assets.info(name).symmetry for name in entry.names}
    predictions = {
        "network": predictor.predict(windows),
        "constant": constant(windows),
        "analytic": analytic(shapes, windows),
    }
    if entry.key == _UNSEEN:
        predictions["without"] = learned(read_network(shipped("pushes_without_two")), shapes, windows)
    return Scored(
        windows, predictions["network"], {key: errors(windows, p, symmetries) for key, p in predictions.items()}
    )
