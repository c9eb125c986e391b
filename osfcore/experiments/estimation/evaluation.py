"""How good estimators are: first frames, tracking without masks, goals, ablations and spoiled inputs.

Each task is a random scene of known objects under a hidden light that stands 10 degrees or higher. First
frames show it to four cameras with masks. Tracks follow 20 steps of pushes without masks, each estimate starting from
the last one. Goals show some objects elsewhere under another light to the goal camera. Nothing of the truth ever
reaches an estimator. Each finished part of a task is kept, so that an evaluation can be killed, resumed and run in
pieces; pictures and report.json lie beside the kept results.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from concurrent.futures import Executor
from dataclasses import dataclass

from osfcore.errors import InvalidInput, MissingAssets, check_ranges, check_seed
from osfcore.experiments.estimation.parts import PARTS, VIEWS, EvaluateEstimate, TaskRunner
from osfcore.experiments.estimation.plots import bad_failure, frame_failure, track_failure, write_gallery, write_plots
from osfcore.experiments.estimation.report import EstimateReport
from osfcore.experiments.estimation.scores import FrameScore, TrackScore
from osfcore.experiments.estimation.spoiled_inputs import BadScore
from osfcore.experiments.fields.evaluation import MAX_TASKS
from osfcore.experiments.pieces import Piece, results_of
from osfcore.experiments.rearrangement.factors import factor_named
from osfcore.experiments.task_cache import TaskResult
from osfcore.fields.field_library import FieldLibrary
from osfcore.geometry.cameras import image_side
from osfcore.geometry.states import MAX_OBJECTS
from osfcore.io.files import write_json
from osfcore.io.json_codec import decode
from osfcore.objects.asset_library import AssetLibrary

REPORT_FILE = "report.json"
_FACTOR = "factor_"  # and its name: a part
_Results = dict[str, list[TaskResult]]


@dataclass(frozen=True, eq=False, slots=True)
class EstimateEvaluationStep:
    """How far an evaluation is.

    Attributes:
        done: parts of tasks finished.
        total: parts of tasks in all.
        note: what is being done.
        report: with the last step only.
    """

    done: int
    total: int
    note: str
    report: EstimateReport | None = None


def evaluate_estimate(
    config: EvaluateEstimate, fields: FieldLibrary, assets: AssetLibrary, executor: Executor | None = None
) -> Iterator[EstimateEvaluationStep]:
    """Measure every part that is asked for, task by task; pictures and report.json go to `config.folder`.

    Args:
        config: what to measure.
        fields: of the objects and the table.
        assets: meshes, for the simulator.
        executor: does tasks side by side, if given; then their times are those of a busy machine.

    Raises:
        UnknownName, MissingAssets: if an object lacks a field or a mesh, or no factor is called so.
        InvalidInput: if a number is out of range.
        WorkerDied: if a worker process ended.
        CorruptFile, CannotWrite: as files are.
    """
    runner = TaskRunner(config, _checked(config, fields, assets), fields, assets)
    kept: _Results = {}
    jobs = _jobs(config, runner, kept)
    total, done = sum(count for _, count, _ in jobs.values()), 0
    for key, (title, count, work) in jobs.items():
        for results in results_of([work(number) for number in range(count)], executor):
            kept[key] = [result for result in results if result is not None]
            if (ready := len(kept[key])) < count:
                yield EstimateEvaluationStep(done + ready, total, f"{title} ({ready + 1} of {count})")
        done += count
    report = _report(kept)
    write_plots(config.folder, report)
    _galleries(config, kept)
    write_json(config.folder / REPORT_FILE, report.to_json())
    yield EstimateEvaluationStep(total, total, "Everything is measured", report)


_Job = tuple[str, int, Callable[[int], Piece]]  # what it is called, how many, and one of them


def _jobs(config: EvaluateEstimate, runner: TaskRunner, kept: _Results) -> dict[str, _Job]:
    """What there is to do, in order; tracks and goals begin with the first frames in `kept`."""
    tasks = config.tasks
    jobs: dict[str, _Job] = {"first": ("First frames", tasks, runner.first)}
    if "track" in config.parts:
        jobs["track"] = "Tracks", tasks, lambda number: runner.track(number, kept["first"][number])
    if "goal" in config.parts:
        jobs["goal"] = "Goals", tasks, lambda number: runner.goal(number, kept["first"][number])
    if "ablations" in config.parts:
        jobs["fixed_light"] = "Light held overhead", tasks, runner.fixed_light
        for views in VIEWS:
            jobs[f"views_{views}"] = f"{views} of 4 views", tasks, _few_views(runner, views)
    for factor in config.factors:
        jobs[f"{_FACTOR}{factor}"] = f"Factor {factor}", tasks, _varied(runner, factor)
    if config.bad:
        jobs["bad"] = "Bad cases", config.bad, runner.bad
    return jobs


def _few_views(runner: TaskRunner, views: int) -> Callable[[int], Piece]:
    return lambda number: runner.few_views(number, views)


def _varied(runner: TaskRunner, factor: str) -> Callable[[int], Piece]:
    return lambda number: runner.varied(number, factor)


def _checked(config: EvaluateEstimate, fields: FieldLibrary, assets: AssetLibrary) -> tuple[str, ...]:
    """The objects to draw from, after everything asked for was found possible."""
    check_ranges(
        ("number of tasks", config.tasks, 1, MAX_TASKS),
        ("number of bad cases", config.bad, 0, MAX_TASKS),
        ("objects in a scene", config.objects, 1, MAX_OBJECTS),
    )
    check_seed(config.seed)
    for part in config.parts:
        if part not in PARTS:
            raise InvalidInput("part", part, f"one of {', '.join(PARTS)}")
    for factor in config.factors:
        factor_named(factor)  # raises UnknownName
    image_side(config.size)
    known = tuple(name for name in fields.names() if assets.has(name))
    if config.names is None and not known:
        raise MissingAssets(list(fields.names()))
    names = known if config.names is None else tuple(dict.fromkeys(config.names))
    for name in names:
        fields.info(name)  # raises UnknownName
    missing = [name for name in names if not assets.has(name)]
    if missing:
        assets.info(missing[0])
        raise MissingAssets(missing)
    least = config.objects + (1 if config.bad else 0)  # a bad case calls an object by another's name
    if len(names) < least:
        raise InvalidInput("number of names", len(names), f"{least} or more for {config.objects} objects in a scene")
    if config.bad and config.objects < 2:
        raise InvalidInput("objects in a scene", config.objects, "2 or more with bad cases, which swap masks")
    return names


def _report(kept: _Results) -> EstimateReport:
    def frames(key: str) -> tuple[FrameScore, ...]:
        return tuple(decode(FrameScore, result.figures["score"], "score") for result in kept[key])

    tracks = kept.get("track")
    bad = kept.get("bad")
    return EstimateReport(
        first=frames("first"),
        tracks=None
        if tracks is None
        else tuple(decode(TrackScore, result.figures["score"], "score") for result in tracks),
        goals=tuple(map(_goal_scores, kept["goal"])) if "goal" in kept else None,
        fixed_light=frames("fixed_light") if "fixed_light" in kept else None,
        views={views: frames(f"views_{views}") for views in VIEWS} if "fixed_light" in kept else None,
        bad=None if bad is None else tuple(decode(BadScore, result.figures["score"], "score") for result in bad),
        factors={key.removeprefix(_FACTOR): frames(key) for key in kept if key.startswith(_FACTOR)},
    )


def _goal_scores(result: TaskResult) -> tuple[FrameScore, ...]:
    return tuple(decode(FrameScore, score, "score") for score in result.figures["scores"])


def _galleries(config: EvaluateEstimate, kept: _Results) -> None:
    """What went wrong, each part in a picture of its own."""
    folder = config.folder
    factors = [key for key in kept if key.startswith(_FACTOR)]
    for key in ("first", "fixed_light", *(f"views_{views}" for views in VIEWS), *factors):
        if key in kept:
            scores = [decode(FrameScore, result.figures["score"], "score") for result in kept[key]]
            failures = [frame_failure(f"task {n}", score, kept[key][n].shown) for n, score in enumerate(scores)]
            write_gallery(folder / f"failures_{key}.png", failures)
    if "track" in kept:
        tracks = [decode(TrackScore, result.figures["score"], "score") for result in kept["track"]]
        failures = [track_failure(f"task {n}", score, kept["track"][n].shown) for n, score in enumerate(tracks)]
        write_gallery(folder / "failures_track.png", failures)
    if "goal" in kept:
        failures = []
        for n, result in enumerate(kept["goal"]):
            for m, (score, shown) in enumerate(zip(_goal_scores(result), result.shown, strict=True)):
                failures.append(frame_failure(f"task {n}, goal with {m + 1} moved", score, (shown,)))
        write_gallery(folder / "failures_goal.png", failures)
    if "bad" in kept:
        bad = [decode(BadScore, result.figures["score"], "score") for result in kept["bad"]]
        failures = [bad_failure(f"bad case {n}", score, kept["bad"][n].shown) for n, score in enumerate(bad)]
        write_gallery(folder / "failures_bad.png", failures)
