"""How well tables become what a goal image shows (paper, section 5.4 and figure 7).

The loop sees four cameras, masks in the first frame, and the goal image; it has 30 actions, or as many as are asked
for. The same tasks are given to the same planner with true poses and the simulator as its dynamics (an oracle: an upper
bound), and to nobody. A goal that is refused counts as a failure, for nothing is moved then; beside it stands what
happens if the doubt is overruled. Results of finished tasks are kept in the output folder: a killed evaluation goes on
where it was.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from concurrent.futures import Executor
from dataclasses import asdict, dataclass, field, replace
from functools import partial
from pathlib import Path
from typing import Any

from osfcore import control, dynamics, estimation, experiments, metrics, paper, planning, render, world
from osfcore.control.episode_settings import CostKind, EpisodeSettings
from osfcore.dynamics.push_models import network_path
from osfcore.errors import InvalidInput, MissingAssets, check_seed
from osfcore.experiments.pieces import Piece, results_of
from osfcore.experiments.rearrangement.factors import factor_named
from osfcore.experiments.rearrangement.measured_episodes import METHODS, MeasuredEpisodes, Method
from osfcore.experiments.rearrangement.report import MpcReport, write_pictures
from osfcore.experiments.rearrangement.tasks import Family, TaskSet, check_tasks
from osfcore.experiments.task_cache import TaskCache, TaskResult, code_sha256, file_sha256
from osfcore.fields.field_library import FieldLibrary
from osfcore.io.files import write_json
from osfcore.objects.asset_library import AssetLibrary
from osfcore.paper.dynamics.weights import weights_path
from osfcore.paper.stages import STAGES, StageName, check_stages, paper_field_names, paper_field_path
from osfcore.planning.mppi import PlanSettings

REPORT_FILE = "mpc.json"
MAX_TASKS = 10_000
_ORACLE_PLAN = PlanSettings(samples=96)
_ORACLE_REACHED_RAD = 0.05  # half of what counts as success: ours stops earlier
_ORACLE_REPLANS_EVERY = 2

_Work = Callable[[int, EpisodeSettings], TaskResult]


@dataclass(frozen=True, slots=True)
class EvaluateMpc:
    """What to measure.

    Attributes:
        folder: for results, pictures and mpc.json.
        data_dir: where objects, and fields and networks trained on this machine, are.
        tasks: how many.
        objects: in each scene.
        seed: of the tasks.
        family: what goals ask for.
        actions: that an episode may have.
        method: whose episodes.
        ours: stages of the paper's method that are replaced by ours.
        factor: name of what differs from the usual world; "" for nothing.
        cost: what futures are compared by.
        names: objects to draw from; all that have a field and a mesh if None.
        oracle: also run the planner that is told the truth.
        settings: of the episodes but for their cost and number of actions.
        oracle_plan: how the oracle plans.
    """

    folder: Path
    data_dir: Path
    tasks: int = 20
    objects: int = 3
    seed: int = 0
    family: Family = "shifted"
    actions: int = 30
    method: Method = "ours"
    factor: str = ""
    cost: CostKind = "pose"
    names: tuple[str, ...] | None = None
    oracle: bool = True
    settings: EpisodeSettings = field(default_factory=EpisodeSettings)
    oracle_plan: PlanSettings = _ORACLE_PLAN
    ours: tuple[StageName, ...] = ()


@dataclass(frozen=True, eq=False, slots=True)
class MpcEvaluationStep:
    """How far an evaluation is.

    Attributes:
        done: tasks finished, ours and the oracle's.
        total: in all.
        note: what is being done.
        report: with the last step only.
    """

    done: int
    total: int
    note: str
    report: dict[str, Any] | None = None


def evaluate_mpc(
    config: EvaluateMpc, fields: FieldLibrary, assets: AssetLibrary, executor: Executor | None = None
) -> Iterator[MpcEvaluationStep]:
    """Run all tasks; pictures and mpc.json go to `config.folder`.

    Args:
        config: what to measure.
        fields: of the objects.
        assets: meshes for the simulator.
        executor: runs tasks side by side, if given; then their times are those of a busy machine.

    Raises:
        UnknownName, MissingAssets: if an object lacks a field or a mesh, or no factor is called so.
        InvalidInput: if a number is out of range.
        NoRoom: if there is no room for a task's objects.
        WorkerDied: if a worker process ended.
        CorruptFile, CannotWrite: as files are.
    """
    config = replace(config, names=_checked(config, fields, assets))
    pieces = _pieces(config, fields, assets)
    total = len(pieces)
    results: list[TaskResult | None] = []
    for results in results_of(pieces, executor):
        done = sum(result is not None for result in results)
        if done < total:
            yield MpcEvaluationStep(done, total, f"{done} of {total} episodes")
    finished = [result for result in results if result is not None]
    report = MpcReport(tuple(finished[: config.tasks]), tuple(finished[config.tasks :]))
    write_pictures(config.folder, report)
    about = {key: getattr(config, key) for key in ("family", "objects", "actions", "seed", "method", "factor", "cost")}
    figures = {**report.to_json(), **about, "ours": list(config.ours)}
    write_json(config.folder / REPORT_FILE, figures)
    yield MpcEvaluationStep(total, total, "Everything is measured", figures)


def _checked(config: EvaluateMpc, fields: FieldLibrary, assets: AssetLibrary) -> tuple[str, ...]:
    if not 1 <= config.tasks <= MAX_TASKS:
        raise InvalidInput("number of tasks", config.tasks, f"between 1 and {MAX_TASKS}")
    if config.method not in METHODS:
        raise InvalidInput("method", repr(config.method), f"one of {', '.join(METHODS)}")
    if config.factor:
        factor_named(config.factor)
    _check_stages(config)
    check_seed(config.seed)
    if config.names is None:
        known = paper_field_names(config.data_dir) if _published(config, "fields") else fields.names()
        names = tuple(name for name in known if fields.has(name) and assets.has(name))
    else:
        names = tuple(dict.fromkeys(config.names))
        for name in names:
            fields.info(name)
            if not assets.has(name):
                raise MissingAssets([name])
            if _published(config, "fields"):
                paper_field_path(name, config.data_dir)
    check_tasks(_tasks(replace(config, names=names)))
    return names


def _check_stages(config: EvaluateMpc) -> None:
    replaced = check_stages(config.ours)
    if replaced and config.method != "paper":
        raise InvalidInput("stages of ours", ", ".join(config.ours), "given with method paper alone")
    if len(replaced) == len(STAGES):
        raise InvalidInput("stages of ours", "all of them", "some; method ours is what replaces all")


def _published(config: EvaluateMpc, stage: StageName) -> bool:
    """Whether a stage is the paper's."""
    return config.method == "paper" and stage not in config.ours


def _tasks(config: EvaluateMpc) -> TaskSet:
    return TaskSet(config.names or (), config.family, config.objects, config.seed)


def _pieces(config: EvaluateMpc, fields: FieldLibrary, assets: AssetLibrary) -> list[Piece]:
    """Our episodes, then the oracle's."""
    assert config.names is not None
    settings = replace(config.settings, cost=config.cost, steps=config.actions)
    told_truth = replace(
        config.settings, steps=config.actions, plan=config.oracle_plan, replan_every=_ORACLE_REPLANS_EVERY,
        reached_rad=_ORACLE_REACHED_RAD,
    )  # fmt: skip
    episodes = MeasuredEpisodes(_tasks(config), fields, assets, config.data_dir, config.factor, frozenset(config.ours))
    given = {
        "names": {name: [file_sha256(fields.info(name).path), assets.digest(name)] for name in config.names},
        "network": file_sha256(network_path(config.data_dir)),
        "code": code_sha256(control, dynamics, estimation, experiments, metrics, paper, planning, render, world),
    }
    if _published(config, "fields"):
        given["paper_fields"] = [file_sha256(paper_field_path(name, config.data_dir)) for name in config.names]
    if _published(config, "dynamics"):
        given["paper_network"] = file_sha256(weights_path(config.data_dir))
    folder = config.folder / "mpc" / f"{config.family}-{config.objects}-{config.seed}-{config.actions}"
    method = "-".join(part for part in (config.method, *sorted(config.ours), config.cost, config.factor) if part)
    kinds: list[tuple[str, EpisodeSettings, _Work]] = [
        (method, settings, partial(episodes.from_images, method=config.method))
    ]
    if config.oracle:
        kinds.append(("oracle", told_truth, episodes.oracle))
    return [
        Piece(f"{n:04d}", TaskCache(folder / kind), {**given, "settings": asdict(how)}, partial(work, n, how))
        for kind, how, work in kinds
        for n in range(config.tasks)
    ]
