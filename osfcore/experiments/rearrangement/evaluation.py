"""How well tables become what a goal image shows (paper, section 5.4 and figure 7).

The loop sees four cameras, masks in the first frame, and the goal image; it has 30 actions, or as many as are asked
for. The same tasks are given to the same planner with true poses, whose best of several tries counts (an oracle: an
upper bound), and to nobody. A goal that is refused counts as a failure, for nothing is moved then; beside it stands
what happens if the doubt is overruled. Results of finished tasks are kept in the output folder: a killed evaluation
goes on where it was. Methods other than ours refuse no goal.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import Executor
from dataclasses import asdict, dataclass, field, replace
from functools import partial
from pathlib import Path
from typing import Any

from osfcore.control.episode_settings import CostKind, EpisodeSettings
from osfcore.dynamics.push_models import network_path, shipped
from osfcore.errors import InvalidInput, MissingAssets, check_ranges, check_seed
from osfcore.experiments.image_methods import field_path, known_names
from osfcore.experiments.pieces import EvaluationStep, Piece, finished
from osfcore.experiments.rearrangement.factors import UNSEEN_NETWORK, factor_named
from osfcore.experiments.rearrangement.measured_episodes import MeasuredEpisodes
from osfcore.experiments.rearrangement.methods import Variant, check_variant
from osfcore.experiments.rearrangement.report import MpcReport, write_pictures
from osfcore.experiments.rivals.fitvid.weights import fitvid_path
from osfcore.experiments.rivals.visual_foresight import ForesightSettings
from osfcore.experiments.task_cache import TaskCache, TaskResult, file_sha256, table_sha256
from osfcore.fields.field_library import FieldLibrary
from osfcore.io.files import write_json
from osfcore.objects.asset_library import AssetLibrary
from osfcore.paper.dynamics.weights import weights_path
from osfcore.paper.mppi import GaussianPlanSettings
from osfcore.planning.mppi import PlanSettings
from osfcore.world.rearrangement_tasks import Family, TaskSet, check_tasks

REPORT_FILE = "mpc.json"
MAX_TASKS = 10_000
MAX_TRIES = 1000
ORACLE_PLAN = PlanSettings(samples=192)
_ORACLE_REACHED_RAD = 0.05  # half of what counts as success: ours stops earlier

VERSION = 1  # raised by hand when figures may change

Plan = PlanSettings | GaussianPlanSettings | ForesightSettings
_Work = Callable[[int], TaskResult]


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
        variant: whose episodes, and through how many cameras.
        factor: name of what differs from the usual world; "" for nothing.
        cost: what futures are compared by.
        names: objects to draw from; all that have a field and a mesh if None.
        oracle: also run the planner that is told the truth.
        oracle_tries: that it has at each task.
        settings: of the episodes but for their cost and number of actions.
        oracle_plan: how the oracle plans.
        published: how planning as published samples.
        foresight: how visual foresight plans.
    """

    folder: Path
    data_dir: Path
    tasks: int = 20
    objects: int = 3
    seed: int = 0
    family: Family = "shifted"
    actions: int = 30
    variant: Variant = field(default_factory=Variant)
    factor: str = ""
    cost: CostKind = "pose"
    names: tuple[str, ...] | None = None
    oracle: bool = True
    oracle_tries: int = 8
    settings: EpisodeSettings = field(default_factory=EpisodeSettings)
    oracle_plan: PlanSettings = ORACLE_PLAN
    published: GaussianPlanSettings = field(default_factory=GaussianPlanSettings)
    foresight: ForesightSettings = field(default_factory=ForesightSettings)

    @property
    def plan(self) -> Plan:
        """How the method plans."""
        if self.variant.method == "foresight":
            return self.foresight
        return self.published if self.variant.published("planning") else self.settings.plan


def evaluate_mpc(
    config: EvaluateMpc, fields: FieldLibrary, assets: AssetLibrary, executor: Executor | None = None
) -> Iterator[EvaluationStep]:
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
    pieces = episode_pieces(config, fields, assets)
    results = yield from finished(pieces, executor, "episodes")
    report = episodes_report(config, results)
    write_pictures(config.folder, report)
    figures = figures_of(config, report)
    write_json(config.folder / REPORT_FILE, figures)
    yield EvaluationStep(len(pieces), len(pieces), "Everything is measured", figures)


def episodes_report(config: EvaluateMpc, results: Sequence[TaskResult]) -> MpcReport:
    """What the results of `episode_pieces` tell, in their order."""
    is_ours = config.variant.method == "ours"
    return MpcReport(tuple(results[: config.tasks]), tuple(results[config.tasks :]), may_refuse=is_ours)


def figures_of(config: EvaluateMpc, report: MpcReport) -> dict[str, Any]:
    """The figures of a report with what was measured, as plain JSON."""
    about = {key: getattr(config, key) for key in ("family", "objects", "actions", "seed", "factor")}
    variant = config.variant
    about["cost"] = "image" if variant.method == "foresight" or variant.published("planning") else config.cost
    about |= {"names": list(config.names or ()), "samples": config.plan.samples, "horizon": config.plan.horizon}
    about |= {"method": variant.method, "views": variant.views, "masks": variant.has_masks}
    about |= {"ours": sorted(variant.replaced), "truths": sorted(variant.truths)}
    return {**report.to_json(), **about}


def _checked(config: EvaluateMpc, fields: FieldLibrary, assets: AssetLibrary) -> tuple[str, ...]:
    check_ranges(
        ("number of tasks", config.tasks, 1, MAX_TASKS),
        ("number of the oracle's tries", config.oracle_tries, 1, MAX_TRIES),
    )
    check_variant(config.variant)
    if config.factor and factor_named(config.factor).has_unseen_objects and config.variant.published("dynamics"):
        allowed = "left out with the paper's dynamics: they are of objects that have a name"
        raise InvalidInput("factor of variation", config.factor, allowed)
    check_seed(config.seed)
    if config.names is None:
        known = known_names(config.variant.fields, fields, config.data_dir)
        names = tuple(name for name in known if fields.has(name) and assets.has(name))
    else:
        names = tuple(dict.fromkeys(config.names))
        for name in names:
            fields.info(name)
            if not assets.has(name):
                raise MissingAssets([name])
            field_path(config.variant.fields, name, fields, config.data_dir)
    check_tasks(_tasks(replace(config, names=names)))
    return names


def _tasks(config: EvaluateMpc) -> TaskSet:
    return TaskSet(config.names or (), config.family, config.objects, config.seed)


def episode_pieces(config: EvaluateMpc, fields: FieldLibrary, assets: AssetLibrary) -> list[Piece]:
    """The method's episodes, then the oracle's, after everything asked for was found possible.

    Args:
        config: what to measure.
        fields: of the objects.
        assets: meshes for the simulator.

    Raises:
        UnknownName, MissingAssets, InvalidInput, NoRoom: as `evaluate_mpc` does.
    """
    config = replace(config, names=_checked(config, fields, assets))
    settings = replace(config.settings, cost=config.cost, steps=config.actions, renewed=False)
    told_truth = replace(
        config.settings, steps=config.actions, plan=config.oracle_plan, reached_rad=_ORACLE_REACHED_RAD, renewed=False
    )
    episodes = MeasuredEpisodes(_tasks(config), fields, assets, config.data_dir, config.factor, config.variant)
    given, own = _circumstances(config, fields, assets)
    folder = config.folder / "mpc" / f"{config.family}-{config.objects}-{config.seed}-{config.actions}"
    usual = type(config.plan)()
    parts = (config.variant.name(), config.cost, _plan_name(config.plan, usual), config.factor)
    method = "-".join(part for part in parts if part)
    kinds: list[tuple[str, dict[str, Any], _Work]]
    if config.variant.method == "foresight":
        work: _Work = partial(episodes.by_foresight, settings=config.foresight, actions=settings.steps)
    else:
        work = partial(episodes.from_images, settings=settings, published=config.published)
    kinds = [(method, {**own, "settings": asdict(settings), "plan": asdict(config.plan)}, work)]
    if config.oracle:
        told = "-".join(part for part in ("oracle", _plan_name(config.oracle_plan, ORACLE_PLAN)) if part)
        tries = config.oracle_tries
        work = partial(episodes.oracle, settings=told_truth, tries=tries)
        kinds.append((told, {"settings": asdict(told_truth), "tries": tries}, work))
    return [
        Piece(f"{n:04d}", TaskCache(folder / kind), {**given, **circumstances}, partial(work, n))
        for kind, circumstances, work in kinds
        for n in range(config.tasks)
    ]


def _plan_name(plan: Plan, usual: Plan) -> str:
    """What tells results of unusual plans from others."""
    return "" if plan == usual else f"K{plan.samples}T{plan.horizon}"


def _circumstances(
    config: EvaluateMpc, fields: FieldLibrary, assets: AssetLibrary
) -> tuple[dict[str, Any], dict[str, Any]]:
    """What all results depend on, and what those of the method do besides."""
    names = config.names or ()
    given = {
        "names": {name: [file_sha256(fields.info(name).path), assets.digest(name)] for name in names},
        "network": file_sha256(network_path(config.data_dir)),
        "table": table_sha256(fields.load_table()),
        "version": VERSION,
    }
    own: dict[str, Any] = {}
    if config.variant.fields != "ours":
        paths = [field_path(config.variant.fields, name, fields, config.data_dir) for name in names]
        own["own_fields"] = [file_sha256(path) for path in paths]
    if config.variant.published("dynamics"):
        own["own_network"] = file_sha256(weights_path(config.data_dir))
    if config.variant.method == "foresight":
        own["own_network"] = file_sha256(fitvid_path(config.data_dir))
    if config.factor and factor_named(config.factor).has_unseen_objects:
        own["own_network"] = file_sha256(shipped(UNSEEN_NETWORK))
    return given, own
