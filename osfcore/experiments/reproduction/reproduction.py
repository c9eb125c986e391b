"""`osf reproduce`: the paper's experiments, with its rivals and what else there is to know, in one report."""

from __future__ import annotations

import base64
import io
import re
from collections.abc import Callable, Generator, Iterator, Mapping, Sequence
from concurrent.futures import Executor
from dataclasses import asdict, dataclass, field, replace
from importlib.resources import files
from itertools import takewhile
from pathlib import Path
from typing import Any, Literal, NamedTuple, get_args

import numpy as np
from PIL import Image

from osfcore.control.events import EpisodeSettings
from osfcore.errors import InvalidInput, check_seed
from osfcore.experiments import relighting, unrolled_estimation, video_prediction
from osfcore.experiments.charts import Axis, Bar, Bars, Chart, Curve, svg
from osfcore.experiments.dynamics import COUNTS, DynamicsMethod, EvaluateDynamics, evaluate_dynamics
from osfcore.experiments.factors import EPISODE_FACTORS
from osfcore.experiments.harness import EvaluationStep, finished
from osfcore.experiments.images import FIELD_METHODS, TITLES, common_names
from osfcore.experiments.photos import EvaluatePhotos, described, evaluate_photos, starts_of
from osfcore.experiments.rearrangement import (
    EvaluateMpc,
    MpcReport,
    checked,
    episode_pieces,
    episodes_report,
    figures_of,
    paired,
)
from osfcore.experiments.rearrangement_runs import TRUTHS, Variant
from osfcore.experiments.relighting import CompareRelighting, compare_relighting
from osfcore.experiments.rivals.visual_foresight import ForesightSettings
from osfcore.experiments.statistics import holm, share_interval
from osfcore.experiments.unrolled_estimation import UnrollEstimates, unrolled_estimates
from osfcore.experiments.video_prediction import CompareVideos, compare_videos
from osfcore.extras import need
from osfcore.fields.field_library import FieldLibrary
from osfcore.io.files import write_atomically, write_json
from osfcore.metrics.success import RearrangementScore
from osfcore.objects.asset_library import AssetLibrary
from osfcore.paper.mppi import STEPS, GaussianPlanSettings
from osfcore.paper.stages import StageName
from osfcore.planning.mppi import PlanSettings
from osfcore.world.tasks import Family

# Which episodes the report shows: sections of cells, each of which is one method on one set of tasks.
#
# All cells with the same family and number of objects get the same tasks, so that any two can be compared task by task.
# Cells that stand in several sections, such as ours in the usual world, are measured once.


SectionName = Literal["methods", "families", "ablations", "ladder", "factors", "attribution"]
SECTIONS: tuple[SectionName, ...] = get_args(SectionName)
_LADDER: tuple[StageName, ...] = ("estimation", "dynamics", "planning", "fields")  # the order in which ours come in
_ORACLE = "told the truth"
_METHODS = {
    "ours": Variant(),
    "as published": Variant("paper"),
    "compositional NeRF": Variant("nerf"),
    "visual foresight": Variant("foresight"),
    "light overhead": Variant("overhead"),
    "light known": Variant("known_light"),
}


@dataclass(frozen=True, slots=True)
class Scale:
    """How much is measured.

    Attributes:
        tasks: of each cell.
        headline: of the methods with three objects.
        counts: numbers of objects that the methods are compared with.
        objects: in the scenes of all other sections.
        settings: of the episodes.
        published: how planning as published samples.
        foresight: how visual foresight plans.
        factors: of variation.
        families: beside `shifted`, with three objects.
        has_upright: whether methods are also compared on objects that stand upright, as the paper's seem to.
        scenes: that fields are compared on.
        videos: that predictions are compared on.
        frames: whose estimates are shown step by step.
        pushes: episodes of each policy that predicted poses are compared on.
        has_slow_cells: also the light overhead, two views, shorter plans, and ours with the published fields.
    """

    tasks: int = 50
    headline: int = 100
    counts: tuple[int, ...] = (2, 3, 4)
    objects: int = 3
    settings: EpisodeSettings = field(default_factory=lambda: EpisodeSettings(STEPS))
    published: GaussianPlanSettings = field(default_factory=GaussianPlanSettings)
    foresight: ForesightSettings = field(default_factory=ForesightSettings)
    factors: tuple[str, ...] = EPISODE_FACTORS
    families: tuple[Family, ...] = ("turned", "crowded", "relit")
    has_upright: bool = True
    scenes: int = 20
    videos: int = 20
    frames: int = 20
    pushes: int = 20
    has_slow_cells: bool = True


_FEW = EpisodeSettings(steps=12, plan=PlanSettings(samples=32, horizon=10))
QUICK = Scale(
    tasks=3, headline=3, counts=(1,), objects=1, settings=_FEW, published=GaussianPlanSettings(48, 8),
    foresight=ForesightSettings(8, 6), factors=("light_low",), families=(), has_upright=False, scenes=3,
    videos=3, frames=1, pushes=1, has_slow_cells=False,
)  # fmt: skip


class Cell(NamedTuple):
    """One method on one set of tasks, with its label in tables and charts."""

    label: str
    config: EvaluateMpc


class Section(NamedTuple):
    """Cells that are compared.

    Attributes:
        name: of the section.
        title: over it.
        text: on what is compared.
        cells: the first of which all others are compared with.
        left_out: labels of what has no finished tasks, if only these are shown.
    """

    name: SectionName
    title: str
    text: str
    cells: tuple[Cell, ...]
    left_out: tuple[str, ...] = ()


def _counted(count: int, what: str) -> str:
    """Return words such as "1 object" and "2 objects"."""
    return f"{count} {what}{'s' * (count > 1)}"


def _objects(figures: Mapping[str, Any]) -> str:
    """Return how many objects a cell's tasks have, and how they stand, in words."""
    return _counted(figures["objects"], "object") + " that stand upright" * (figures["family"] == "upright")


def sections_of(base: EvaluateMpc, scale: Scale, chosen: tuple[SectionName, ...] = SECTIONS) -> tuple[Section, ...]:
    """Return all sections with two cells or more, in their order.

    Args:
        base: where results are kept, the objects to draw from, and the seed.
        scale: how much is measured.
        chosen: sections that are shown.
    """
    settings = scale.settings
    base = replace(
        base, tasks=scale.tasks, objects=scale.objects, settings=settings, actions=settings.steps, oracle=False,
        published=scale.published, foresight=scale.foresight,
    )  # fmt: skip
    families = [Cell(f"goals {family}", replace(base, family=family)) for family in ("shifted", *scale.families)]
    factors = [Cell("usual world", base)] + [Cell(name, replace(base, factor=name)) for name in scale.factors]
    variants = {"ours": Variant(), "true light": Variant("known_light")}
    variants |= {f"true {truth}": Variant(truths=frozenset({truth})) for truth in TRUTHS}
    variants["all true"] = Variant(truths=frozenset(TRUTHS))
    attributed = [Cell(label, replace(base, variant=variant)) for label, variant in variants.items()]
    harder = "Goals are harder: objects are turned as well, change places, or are photographed under another light."
    differing = "One thing differs from what the method takes for granted, and the method is not told."
    replaced = "One stage at a time is replaced by the truth. This shows what the errors of that stage cost."
    sections = (
        *_methods(base, scale),
        Section("families", "Families of tasks", harder, tuple(families)),
        _ablations(base, scale),
        _ladder(base, scale),
        Section("factors", "Factors of variation", differing, tuple(factors)),
        Section("attribution", "Where episodes fail", replaced, tuple(attributed)),
    )
    return tuple(section for section in sections if section.name in chosen and len(section.cells) > 1)


_METHODS_TEXT = (
    "Each method pushes until the table looks as in the goal image, or until its actions are used up. All methods get "
    "the same tasks, with masks in the first frame alone. The paper has 20 tasks for each method. Ours refuses goals "
    "that it doubts, and then fails. The other methods refuse none: for them, the column counts the goals that our "
    "doubts would have refused."
)
_METHOD_TEXTS = {
    "as published": "“As published” is this project's re-implementation of the paper. The paper's own evaluation gives "
    "masks at every step, as a row of the ablations has them.",
    "compositional NeRF": "NeRFs take the place of the fields in our loop.",
    "visual foresight": "Visual foresight has a FitVid of 4.0 million parameters, told where the pusher is, which "
    "learned for 50 minutes on one core. This says little of the original with its 302 million.",
    "light overhead": "“Light overhead” is our loop without an estimate of the light.",
    "light known": "“Light known” is our loop, told the true light.",
}


def _methods(base: EvaluateMpc, scale: Scale) -> list[Section]:
    sections = []
    worlds: list[tuple[int, Family]] = [(count, "shifted") for count in scale.counts]
    for count, family in [*worlds, *([(scale.objects, "upright")] if scale.has_upright else [])]:
        is_headline = count == scale.objects and family == "shifted"
        tasks = scale.headline if is_headline else scale.tasks
        given = replace(base, objects=count, family=family, tasks=tasks, oracle=is_headline)
        cells = [
            Cell(label, replace(given, variant=variant, oracle=given.oracle and label == "ours"))
            for label, variant in _METHODS.items()
            if scale.has_slow_cells or variant.method != "overhead"
        ]
        title = f"Success with {_objects({'objects': count, 'family': family})} (Fig. 7)"
        sections.append(Section("methods", title, _METHODS_TEXT, tuple(cells)))
    return sections


def _ablations(base: EvaluateMpc, scale: Scale) -> Section:
    plan = base.settings.plan
    cells = [Cell("ours", base), Cell("1 view", replace(base, variant=Variant(views=1)))]
    if scale.has_slow_cells:
        cells.append(Cell("2 views", replace(base, variant=Variant(views=2))))
        shorter = replace(plan, samples=plan.samples // 4), replace(plan, horizon=plan.horizon // 3)
        for label, one in zip((f"K = {shorter[0].samples}", f"T = {shorter[1].horizon}"), shorter, strict=True):
            cells.append(Cell(label, replace(base, settings=replace(base.settings, plan=one))))
    cells.append(Cell("cost of rendered images", replace(base, cost="image")))
    if scale.has_slow_cells:
        cells.append(Cell("light overhead", replace(base, variant=Variant("overhead"))))
    cells.append(Cell("as published", replace(base, variant=Variant("paper"))))
    cells.append(Cell("as published, masks at every step", replace(base, variant=Variant("paper", has_masks=True))))
    text = (
        f"Ours has four views, K = {plan.samples} sequences of T = {plan.horizon} actions and a cost of poses. "
        "Masks are given in the first frame alone. In the last row they are given at every step, as in the paper."
    )
    return Section("ablations", "Ablations", text, tuple(cells))


def _ladder(base: EvaluateMpc, scale: Scale) -> Section:
    cells = [Cell("as published", replace(base, variant=Variant("paper")))]
    for count in range(1, len(_LADDER) - (not scale.has_slow_cells)):
        variant = Variant("paper", frozenset(_LADDER[:count]))
        cells.append(Cell(f"+ our {_LADDER[count - 1]}", replace(base, variant=variant)))
    last = _LADDER[len(cells) - 1 :]
    cells.append(Cell(f"+ our {' and '.join(last)} = ours", base))
    text = "From the published method to ours, one stage at a time. Each row keeps the changes of the rows above it."
    return Section("ladder", "The ladder", text, tuple(cells))


def only_finished(sections: Sequence[Section], fields: FieldLibrary, assets: AssetLibrary) -> tuple[Section, ...]:
    """Return sections with the tasks that need not be run any more.

    A cell has its tasks up to the first that is missing, so that none is left out because it takes long. Cells without
    any are left out, and so are sections without their first cell or without another one.

    Args:
        sections: what was to be measured.
        fields: of the objects.
        assets: meshes for the simulator.

    Raises:
        UnknownName, MissingAssets, InvalidInput: as `evaluate_mpc` does.
    """
    found = []
    for section in sections:
        all_cells = [Cell(label, _up_to_missing(config, fields, assets)) for label, config in section.cells]
        cells = [cell for cell in all_cells if cell.config.tasks > 0]
        if len(cells) > 1 and cells[0] is all_cells[0]:
            left_out = [cell.label for cell in all_cells if cell.config.tasks == 0]
            if section.cells[0].config.oracle > cells[0].config.oracle:
                left_out.append(_ORACLE)
            found.append(section._replace(cells=tuple(cells), left_out=tuple(left_out)))
    return tuple(found)


def _up_to_missing(config: EvaluateMpc, fields: FieldLibrary, assets: AssetLibrary) -> EvaluateMpc:
    """Return a cell with its tasks up to the first that is missing, and with the oracle if it has them as well."""
    is_done = [piece.is_done() for piece in episode_pieces(checked(config, fields, assets), fields, assets)]
    tasks = len(list(takewhile(bool, is_done[: config.tasks])))
    has_oracle = config.oracle and all(is_done[config.tasks : config.tasks + tasks])
    return replace(config, tasks=tasks, oracle=has_oracle)


# Measuring the cells of a report side by side, and what their results say next to each other.

Steps = Iterator[EvaluationStep[dict[str, Any]]]


class MeasuredCell(NamedTuple):
    """Results of a cell.

    Attributes:
        label: in tables and charts.
        report: all results.
        figures: of the report, as plain JSON.
        against: comparison with the section's first cell in the "tasks" that both have, one by one; None for that cell
            itself and for other tasks.
    """

    label: str
    report: MpcReport
    figures: Mapping[str, Any]
    against: Mapping[str, Any] | None


class MeasuredSection(NamedTuple):
    """A section with the results of its cells, in their order."""

    section: Section
    cells: tuple[MeasuredCell, ...]


def measure_cells(
    sections: Sequence[Section], fields: FieldLibrary, assets: AssetLibrary, executor: Executor | None = None
) -> Generator[EvaluationStep[Any], None, list[MeasuredSection]]:
    """Run the episodes of all sections, each once.

    Args:
        sections: what to measure.
        fields: of the objects.
        assets: meshes for the simulator.
        executor: runs episodes side by side, if given.

    Returns:
        Results in the order of the sections.

    Raises:
        UnknownName, MissingAssets, InvalidInput, NoRoom, WorkerDied, CorruptFile, CannotWrite: as `evaluate_mpc` does.
    """
    pieces = [
        [episode_pieces(checked(cell.config, fields, assets), fields, assets) for cell in section.cells]
        for section in sections
    ]
    # Where a piece is kept is the same for equal pieces of several cells.
    unique = {(piece.cache.folder, piece.name): piece for cells in pieces for own in cells for piece in own}
    results = yield from finished(list(unique.values()), executor, "episodes")
    found = dict(zip(unique, results, strict=True))
    measured = []
    for section, own in zip(sections, pieces, strict=True):
        cells: list[MeasuredCell] = []
        for (label, config), parts in zip(section.cells, own, strict=True):
            report = episodes_report(config, [found[piece.cache.folder, piece.name] for piece in parts])
            against = None
            if cells and _tasks_of(section.cells[0].config) == _tasks_of(config):
                both = min(len(report.shipped), len(cells[0].report.shipped))
                against = {"tasks": both, **paired(report.shipped[:both], cells[0].report.shipped[:both])}
            cells.append(MeasuredCell(label, report, figures_of(config, report), against))
        measured.append(MeasuredSection(section, tuple(cells)))
    return measured


def _tasks_of(config: EvaluateMpc) -> tuple[str, int]:
    """Return what a cell's tasks depend on: families differ in them, but for the light of the goal image."""
    return config.family.replace("relit", "shifted"), config.objects


# The report as one HTML file that needs nothing beside it, and as Markdown for a site of documents.


_TEMPLATES = {"report.html": "page.html.jinja", "report.md": "page.md.jinja"}
_PICTURE_PX, _PICTURE_QUALITY = 840, 70
_NOTES = (
    "Intervals are of 95 %: Wilson's for shares, Newcombe's for differences between shares, and a bootstrap over tasks "
    "for means.",
    "p is McNemar's exact test of the tasks that both methods have. In the findings it is corrected by Holm for all "
    "comparisons.",
    "A refused goal counts as a failure, for nothing is moved.",
    "6D distances are means, with symmetries counted. Errors of the first frame are medians.",
)


@dataclass(frozen=True, slots=True)
class About:
    """Circumstances of a report.

    Attributes:
        date: of the run.
        machine: in words.
        command: that was run.
        seed: of everything.
        names: objects that were drawn from.
    """

    date: str
    machine: str
    command: str
    seed: int
    names: tuple[str, ...]


class PagePart(NamedTuple):
    """One part of the page.

    Attributes:
        title: over it.
        text: under the title, a paragraph a line.
        charts: side by side, where there is room.
        pictures: PNGs with what they show, in words.
        heads: of the table's columns.
        rows: of the table, words as they stand there.
    """

    title: str
    text: str
    charts: Sequence[Chart | Bars]
    pictures: Sequence[tuple[Path, str]]
    heads: Sequence[str]
    rows: Sequence[Sequence[str]]


def write_pages(
    folder: Path, about: About, warnings: Sequence[str], findings: Sequence[str], parts: Sequence[PagePart]
) -> None:
    """Write the report; its charts and pictures become part of it.

    Args:
        folder: for report.html and report.md.
        about: circumstances of the report.
        warnings: what a reader must know first.
        findings: in sentences.
        parts: from top to bottom.

    Raises:
        CannotWrite: if the disk refuses.
        MissingExtra: if jinja2 or matplotlib is not installed.
    """
    need("experiments", "The report")
    import jinja2
    from markupsafe import Markup

    given = {"about": about, "warnings": warnings, "findings": findings, "parts": parts, "picture": _data_url}
    given |= {"notes": _NOTES, "svg": lambda chart: Markup(svg([chart])), "plain": Markup}
    for name, template in _TEMPLATES.items():
        is_html = name.endswith(".html")
        environment = jinja2.Environment(
            autoescape=is_html, trim_blocks=True, undefined=jinja2.StrictUndefined,
            finalize=None if is_html else _as_markdown,
        )  # fmt: skip
        source = (files("osfcore.experiments.reproduction") / template).read_text(encoding="utf-8")
        write_atomically(folder / name, environment.from_string(source).render(given).encode())


def _as_markdown(value: object) -> object:
    """Return plain text so that Markdown shows it as it is; what is HTML already stays."""
    return value if hasattr(value, "__html__") else re.sub(r"([\\`*_\[\]<>#|$&])", r"\\\1", str(value))


def _data_url(path: Path) -> str:
    """Return a picture as small as a page needs it."""
    data = io.BytesIO()
    with Image.open(path) as picture:
        picture.thumbnail((_PICTURE_PX, picture.height))
        picture.save(data, "WEBP", quality=_PICTURE_QUALITY, method=6)
    return f"data:image/webp;base64,{base64.b64encode(data.getvalue()).decode()}"


# Charts of a report's sections.


_POINTS = 61
_SHARE = Axis("share of tasks", 0, 1)
_DISTANCE = Axis("6D pose distance, symmetries counted", 0, 0.6)


def _success_chart(section: MeasuredSection) -> Chart:
    """Draw success against threshold, for one number of objects (paper, figure 7)."""
    first = section.cells[0]
    kinds = {cell.label: cell.report.shipped for cell in section.cells} | {"no action": first.report.nothing}
    if first.report.oracle:
        kinds[_ORACLE] = first.report.told_truth
    curves = [_curve(name, scores) for name, scores in kinds.items()]
    return Chart(_objects(first.figures), _DISTANCE, _SHARE, curves)


def _curve(name: str, scores: Sequence[RearrangementScore]) -> Curve:
    """Return the share of tasks within each threshold, with Wilson's interval."""
    places = np.linspace(_DISTANCE.low, _DISTANCE.high or 0.0, _POINTS)
    distances = np.sort([score.pose6d_symmetric for score in scores])
    counts = np.searchsorted(distances, places, side="right")
    band = np.array([share_interval(int(count), len(scores)) for count in counts]).T
    return Curve(name, places, counts / len(scores), band=band)


# What a report's sections say in sentences: who is ahead, who is not, and what costs most.


_COMPARED = {"success_tight": "within 2 cm and 0.1 rad", "success_2cm": "within 2 cm"}
_SIGNIFICANT = 0.05
MOST_LOST = 0.15  # of success, that one factor of variation may cost


def findings(sections: Sequence[MeasuredSection]) -> list[str]:
    """Return a sentence for each comparison of the methods, for the mean distance, and for what costs too much."""
    methods = [section for section in sections if section.section.name == "methods"]
    pairs = [(section.cells[0], cell) for section in methods for cell in section.cells[1:]]
    corrected = iter(holm([_gap(cell, key)["p"] for _, cell in pairs for key in _COMPARED]))
    sentences = [_method(*pair, {key: next(corrected) for key in _COMPARED}) for pair in pairs]
    for section in methods:
        ours = section.cells[0]
        mean, nothing = (ours.figures[f"{who}pose6d_symmetric_mean"] for who in ("", "noaction_"))
        sentences.append(
            f"{_objects(ours.figures)}: tables of ours end at a 6D distance of {mean:.3f} in the mean, and at "
            f"{nothing:.3f} if nothing is done."
        )
    for cell in (cell for section in sections if section.section.name == "factors" for cell in section.cells[1:]):
        lost, low, high = _lead(cell, "success_tight")
        if -_gap(cell, "success_tight")["difference"] > MOST_LOST:
            sentences.append(
                f"Under {cell.label} {lost:.0f} points of success are lost (95 %: {low:.0f} to "
                f"{high:.0f}), more than {100 * MOST_LOST:.0f}."
            )
    return sentences


def _gap(cell: MeasuredCell, key: str) -> Any:  # noqa: ANN401 - a number, or a comparison
    """Return how a cell differs from the first of its section; all methods and all factors have the same tasks."""
    return (cell.against or {})[key]


def _lead(cell: MeasuredCell, key: str) -> tuple[float, float, float]:
    """Return by how much the first cell is ahead of another one, and the interval [percent]."""
    gap = _gap(cell, key)  # the other one minus the first
    low, high = (-100 * end for end in reversed(gap["interval"]))
    return 100 * (0.0 - gap["difference"]), low, high  # never -0


def _method(ours: MeasuredCell, other: MeasuredCell, corrected: Mapping[str, float]) -> str:
    """Compare ours with another method; one is called better where p, corrected for all comparisons, is below 5 %."""
    tasks = _counted(_gap(other, "tasks"), "task")
    sentences = [f"{_objects(ours.figures)}, ours and {other.label}, {tasks}."]
    for key, p in corrected.items():
        lead, low, high = _lead(other, key)
        verdict = f"ours is {'better' if lead > 0 else 'worse'}" if p < _SIGNIFICANT else "no difference is shown"
        about = f"{lead:+.0f} points, 95 %: {low:+.0f} to {high:+.0f}, p = {p:.2g}"
        sentences.append(f"{_COMPARED[key].capitalize()}, {verdict} ({about}).")
    return " ".join(sentences)


_HEADS = (
    "", "tasks", "2 cm and 0.1 rad", "2 cm", "refused", "6D distance", "first frame", "light",
    "points more than the first row",
)  # fmt: skip


def rows_of(section: MeasuredSection) -> list[list[str]]:
    """Return the rows of a section's table, those of the oracle and of doing nothing among them, as plain words."""
    rows = [_row(cell.label, cell.figures, "", cell) for cell in section.cells]
    first = section.cells[0]
    if first.report.oracle:
        rows.append(_row(_ORACLE, first.figures, "oracle_"))
    rows.append(_row("no action", first.figures, "noaction_"))
    return rows


def _row(label: str, figures: Mapping[str, Any], who: str, cell: MeasuredCell | None = None) -> list[str]:
    shares = []
    for key in _COMPARED:
        low, high = figures[f"{who}{key}_interval"]
        shares.append(f"{100 * figures[who + key]:.0f} % ({100 * low:.0f} to {100 * high:.0f})")
    refused, errors, gap = "", ["", ""], ""
    if cell is not None:
        refused = str(figures["refused"])
        mm, deg, light = (figures[f"{key}_median"] for key in ("first_mm", "first_deg", "light_deg"))
        errors = ["" if mm is None else f"{mm:.1f} mm, {deg:.1f}°", "" if light is None else f"{light:.1f}°"]
        if cell.against is not None:
            ahead = cell.against["success_tight"]
            low, high = ahead["interval"]
            gap = f"{100 * ahead['difference']:+.0f} ({100 * low:+.0f} to {100 * high:+.0f}), p = {ahead['p']:.2g}"
    distance = f"{figures[f'{who}pose6d_symmetric_mean']:.3f}"
    return [label, str(figures["tasks"]), *shares, refused, distance, *errors, gap]


# The parts of a report before the episodes, each of one evaluation.


_HORIZONS = (1, 4, 10, 30)  # actions after which predicted poses are compared


def estimation_part(folder: Path, report: Mapping[str, Any]) -> PagePart:
    """Return the part on estimates step by step.

    Args:
        folder: with the pictures.
        report: of `unrolled_estimates`.
    """
    titles = {"mm": "position [mm]", "deg": "rotation [deg]", "light_deg": "light [deg]"}
    rows = []
    for method, figures in report["methods"].items():
        for n, moment in enumerate(unrolled_estimation.MOMENTS):
            values = [figures["moments"][key][n] for key in titles]
            rows.append([TITLES[method], moment, *("-" if value is None else f"{value:.3g}" for value in values)])
    text = (
        f"Medians of the errors of {_counted(report['tasks'], 'first frame')} with "
        f"{_counted(report['objects'], 'object')}. The published estimation holds the light overhead for its first "
        "five iterations. Ours reads the light from the shadows on the table early on. In the pictures, the green cube "
        "is where the light is taken to be, and the white frame is where it is."
    )
    picture = folder / unrolled_estimation.IMAGES_FILE
    pictures = [(picture, "One frame at five moments of its estimate, near and far, by each method")]
    charts = unrolled_estimation.charts_of(report)
    heads = ("", "moment", *titles.values())
    return PagePart("An estimate as it runs (Figs. 2 and 3)", text, charts, pictures, heads, rows)


def dynamics_part(_folder: Path, reports: Mapping[str, Mapping[str, Any]]) -> PagePart:
    """Return the part on predicted poses.

    Args:
        _folder: of the evaluation, of which no file is shown.
        reports: of `evaluate_dynamics`, by method.
    """
    still = next(iter(reports.values()))
    predicted = {TITLES[method]: (report, "median") for method, report in reports.items()}
    predicted |= {"quasi-static": (still, "analytic"), "no motion": (still, "constant")}
    heads = [f"{_counted(horizon, 'action')} [{unit}]" for horizon in _HORIZONS for unit in ("mm", "deg")]
    rows = []
    for title, (report, key) in predicted.items():
        cells = [report[f"{key}_{unit}_{horizon}"] for horizon in _HORIZONS for unit in ("mm", "deg")]
        rows.append([title, *("-" if cell is None else f"{cell:.3g}" for cell in cells)])
    charts, x = [], np.array(_HORIZONS, float)
    for unit, label in {"mm": "median position error [mm]", "deg": "median rotation error [deg]"}.items():
        values = {t: [one[f"{key}_{unit}_{h}"] for h in _HORIZONS] for t, (one, key) in predicted.items()}
        curves = [Curve(title, x, np.array(y, float), dots=True) for title, y in values.items()]
        charts.append(Chart("", Axis("actions of 0.2 s", 0, _HORIZONS[-1]), Axis(label, 0), curves))
    text = (
        f"Medians over the objects that moved, {still['windows']} of them within four actions. No network learned from "
        "these episodes, and they chose nothing. Half of them seek contact, and half are the paper's random ones. "
        "True poses and actions are given. The quasi-static model is an analytic one without learning."
    )
    return PagePart("Predicted poses (Sec. 4.3)", text, charts, [], ("", *heads), rows)


def photos_part(folder: Path, reports: Mapping[str, Mapping[str, Any]]) -> PagePart:
    """Return the part on photographs.

    Args:
        folder: with a folder of contact sheets for each start.
        reports: of `evaluate_photos`, by what searches begin with.
    """
    heads = ("starts", "photograph", "object", "IoU", "position [mm]", "rotation [deg]", "doubted")
    rows = []
    for start, report in reports.items():
        for score in report["scores"]:
            errors = ("-" if score[key] is None else f"{score[key]:.1f}" for key in ("position_mm", "rotation_deg"))
            about = "yes" if score["doubt"] else ""
            rows.append([start, score["scene"], score["name"], f"{score['iou']:.3f}", *errors, about])
    # All starts give much the same pictures; those of the last are of the paper's start, if there are any.
    *_, shown = reports
    sheets = sorted((folder / shown).glob("*.png"))
    pictures = [(sheet, f"{sheet.stem}: photograph, outline of the pose found, object as rendered") for sheet in sheets]
    lamps = {name: errors for report in reports.values() for name, errors in report["light_deg"].items()}
    rows += [["", name, "lamp", "", "", f"{np.median(errors):.1f}", ""] for name, errors in lamps.items()]
    text = (
        "Objects in real photographs, given their masks. Searches begin without a start, or with poses of another "
        f"program; pictures are of the start “{shown}”. Errors are from the true poses where these are known, and else "
        "from poses refined with measured depth. For lamps, the error is the median angle between the estimated and "
        "the true direction."
    )
    return PagePart("Real photographs (Fig. 8)", text, [], pictures, heads, rows)


def relighting_part(folder: Path, report: Mapping[str, Any]) -> PagePart:
    """Return the part on scenes under lights of all elevations.

    Args:
        folder: with the pictures.
        report: of `compare_relighting`.
    """
    titles = {"psnr": "PSNR [dB]", "ssim": "SSIM", "psnr_object": "on objects [dB]", "psnr_shadow": "in shadow [dB]"}
    columns = [(key, relighting.ALL, title) for key, title in titles.items()]
    text = (
        f"{_counted(report['tasks'], 'scene')} with {_counted(report['objects'], 'object')}, under lights between "
        f"{min(report['elevations_deg']):g} and {max(report['elevations_deg']):g} deg above the table. Poses and light "
        "are given."
    )
    pictures = [(folder / relighting.IMAGES_FILE, "One scene under a low, a middle and a high light, by each method")]
    charts, table = relighting.charts_of(report), _table(report, columns)
    return PagePart("Scenes under any light (Fig. 5)", text, charts, pictures, *table)


def video_part(folder: Path, report: Mapping[str, Any]) -> PagePart:
    """Return the part on pushes predicted as images.

    Args:
        folder: with the pictures.
        report: of `compare_videos`.
    """
    spans, titles = next(iter(report["methods"].values()))["psnr"]["spans"], {"psnr": "PSNR [dB]", "ssim": "SSIM"}
    columns = [(key, span, f"{title}, {span} steps") for span in spans for key, title in titles.items()]
    text = (
        f"{_counted(report['tasks'], 'episode')} with {_counted(report['objects'], 'object')} and "
        f"{_counted(report['steps'], 'action')} that are known in advance. Predictions begin with the estimate of the "
        "first frame. FitVid sees two frames of the goal camera instead."
    )
    pictures = [(folder / video_prediction.IMAGES_FILE, "One episode as it was and as each method predicts it")]
    charts, table = video_prediction.charts_of(report), _table(report, columns)
    return PagePart("Predicted futures as images (Fig. 6)", text, charts, pictures, *table)


def _table(
    report: Mapping[str, Any], columns: Sequence[tuple[str, str, str]]
) -> tuple[tuple[str, ...], list[list[str]]]:
    """Return heads and rows: means with intervals, and how much ours is ahead in the first column's measure."""
    key, span, _ = columns[0]
    rows = []
    for method, measures in report["methods"].items():
        cells = [_interval(measures[measure]["spans"][over], "mean") for measure, over, _ in columns]
        gap = report["against"].get(method)
        rows.append([TITLES[method], *cells, "" if gap is None else _interval(gap[key][span], "difference")])
    return ("", *(title for _, _, title in columns), "ours better by [dB]"), rows


def _interval(figure: Mapping[str, Any], what: str) -> str:
    if figure[what] is None:
        return "-"
    if figure["interval"] is None:
        return f"{figure[what]:.3g}"
    low, high = figure["interval"]
    return f"{figure[what]:.3g} ({low:.3g} to {high:.3g})"


# `osf reproduce`: the paper's experiments, with its rivals and what else there is to know, in one report.
#
# Everything is kept as soon as it is measured: a killed run goes on where it was. A full run takes over nothing
# from a quick one, whose episodes are shorter.


PAGE_FILE, MARKDOWN_FILE = _TEMPLATES
FIGURES_FILE = "reproduction.json"
EvaluationName = Literal["estimation", "relighting", "dynamics", "video", "photos"]
EVALUATIONS: tuple[EvaluationName, ...] = get_args(EvaluationName)
PartName = EvaluationName | SectionName
PARTS: tuple[PartName, ...] = (*EVALUATIONS, *SECTIONS)
_EVALUATION_PARTS: Mapping[EvaluationName, Callable[[Path, Any], PagePart]] = {
    "estimation": estimation_part,
    "relighting": relighting_part,
    "dynamics": dynamics_part,
    "video": video_part,
    "photos": photos_part,
}


@dataclass(frozen=True, slots=True)
class Reproduce:
    """What to measure and to report.

    Attributes:
        folder: for report.html, report.md, reproduction.json, pictures, and all results.
        data_dir: where objects, fields and networks of this machine are.
        about: circumstances, as the page shows them; the names are filled in.
        scale: how much is measured.
        is_quick: whether the page must warn that it is little.
        parts: of the report.
        names: objects to draw from; those that all methods have a field of if None.
        photos: folder of photographs as `evaluate_photos` takes them; without one their part is left out.
        is_finished: whether no more episodes are run: cells show those that are there.
    """

    folder: Path
    data_dir: Path
    about: About
    scale: Scale
    is_quick: bool = False
    parts: tuple[PartName, ...] = PARTS
    names: tuple[str, ...] | None = None
    photos: Path | None = None
    is_finished: bool = False


def reproduce(config: Reproduce, fields: FieldLibrary, assets: AssetLibrary, executor: Executor | None = None) -> Steps:
    """Measure what is not measured yet, and write the report.

    Args:
        config: what to measure.
        fields: of the objects.
        assets: meshes for the simulator.
        executor: runs pieces side by side, if given.

    Raises:
        UnknownName, MissingAssets: if an object lacks a field or a mesh.
        InvalidInput: if a number or name is out of range, or only finished episodes are wanted and there are none.
        MissingExtra: if what writes pages or draws charts is not installed.
        NoRoom, WorkerDied, CorruptFile, CannotWrite: as for evaluations.
    """
    need("experiments", "The report")
    check_seed(config.about.seed)
    for part in config.parts:
        if part not in PARTS:
            raise InvalidInput("part of the report", part, ", ".join(PARTS))
    if config.photos is not None and not described(config.photos):
        raise InvalidInput("folder of photographs", config.photos, "one with photo.json, or with folders that have one")
    names = common_names(FIELD_METHODS, config.names, fields, assets, config.data_dir, config.scale.objects)
    config = replace(config, about=replace(config.about, names=names))
    images = dict[EvaluationName, Any]()
    for part, evaluation in _evaluations(config, fields, assets, executor).items():
        if part in config.parts:
            images[part] = yield from evaluation
    base = EvaluateMpc(config.folder, config.data_dir, seed=config.about.seed, names=names)
    chosen: tuple[SectionName, ...] = tuple(name for name in SECTIONS if name in config.parts)
    sections = asked = sections_of(base, config.scale, chosen)
    if config.is_finished:
        sections = only_finished(asked, fields, assets)
        if not (sections or images):
            allowed = "one with tasks of two methods or more, of the same seed, objects and number of actions"
            raise InvalidInput("folder of finished episodes", config.folder, allowed)
    measured = yield from measure_cells(sections, fields, assets, executor)
    report = _figures(config, images, measured)
    write_json(config.folder / FIGURES_FILE, report)
    places = {"dynamics": config.folder / "dynamics", "photos": config.folder / "photos"}
    parts = [_EVALUATION_PARTS[name](places.get(name, config.folder), figures) for name, figures in images.items()]
    parts += _section_parts(measured)
    titles = {section.title for section in sections}
    warnings = _warnings(config, [section.title for section in asked if section.title not in titles])
    write_pages(config.folder, config.about, warnings, report["findings"], parts)
    yield EvaluationStep(1, 1, "The report is written", report)


def _evaluations(
    config: Reproduce, fields: FieldLibrary, assets: AssetLibrary, executor: Executor | None
) -> dict[EvaluationName, Generator[EvaluationStep[Any], None, Any]]:
    """Return what measures each part before the episodes; each returns its report, or its reports by name."""
    scale, folder, data_dir, seed = config.scale, config.folder, config.data_dir, config.about.seed
    given = {"names": config.about.names, "seed": seed, "objects": scale.objects}
    unrolled = UnrollEstimates(folder, data_dir, tasks=scale.frames, methods=unrolled_estimation.METHODS, **given)
    relit = CompareRelighting(folder, data_dir, tasks=scale.scenes, **given)
    videos = CompareVideos(folder, data_dir, tasks=scale.videos, **given)
    names = config.about.names if len(config.about.names) > min(COUNTS) else None  # too few for pushes: all there are
    methods: tuple[DynamicsMethod, ...] = ("ours", "paper")
    pushes = {m: EvaluateDynamics(folder / "dynamics", scale.pushes, seed, names, data_dir, m) for m in methods}
    found = dict[EvaluationName, Generator[EvaluationStep[Any], None, Any]]()
    found["estimation"] = _reported("Estimates", unrolled_estimates(unrolled, fields, assets, executor))
    found["relighting"] = _reported("Scenes under any light", compare_relighting(relit, fields, assets, executor))
    predicted = {method: evaluate_dynamics(one, fields, assets, executor) for method, one in pushes.items()}
    found["dynamics"] = _all_reported("Predicted poses", predicted)
    found["video"] = _reported("Predicted futures", compare_videos(videos, fields, assets, executor))
    if config.photos is not None:
        starts, place = starts_of(config.photos), folder / "photos"
        looked = {s: evaluate_photos(EvaluatePhotos(place / s, config.photos, s), fields) for s in starts}
        found["photos"] = _all_reported("Photographs", looked)
    return found


def _reported(title: str, steps: Iterator[EvaluationStep[Any]]) -> Generator[EvaluationStep[Any], None, Any]:
    """Pass on the steps of an evaluation under a title; return its report."""
    report = None
    for step in steps:
        yield EvaluationStep(step.done, step.total, f"{title}: {step.note}")
        report = step.report
    return report


def _all_reported(
    title: str, evaluations: Mapping[str, Iterator[EvaluationStep[Any]]]
) -> Generator[EvaluationStep[Any], None, Any]:
    """Pass on the steps of several evaluations, one after the other; return their reports by name."""
    reports = {}
    for name, steps in evaluations.items():
        reports[name] = yield from _reported(f"{title}, {name}", steps)
    return reports


def _figures(
    config: Reproduce, images: Mapping[EvaluationName, Any], measured: Sequence[MeasuredSection]
) -> dict[str, Any]:
    sections = []
    for section, cells in measured:
        rows = [{"label": c.label, "figures": dict(c.figures), "against_first": c.against} for c in cells]
        sections.append({"name": section.name, "title": section.title, "cells": rows})
    about = {"about": asdict(config.about), "quick": config.is_quick}
    return {**about, **dict(images), "findings": findings(measured), "sections": sections}


def _warnings(config: Reproduce, unfinished: Sequence[str]) -> list[str]:
    """Return what a reader must know before anything else.

    Args:
        config: what was asked for.
        unfinished: titles of sections that are left out.
    """
    scale, warnings = config.scale, list[str]()
    if config.is_quick:
        warnings.append(
            f"A quick look and no measurement: {_counted(scale.tasks, 'task')} a cell, "
            f"{_counted(scale.settings.steps, 'action')} instead of 30, plans of {scale.settings.plan.samples} "
            f"sequences, {_counted(scale.objects, 'object')}, and only the factor {', '.join(scale.factors)}. The "
            "slowest cells are left out, and intervals are wide."
        )
    left_out = [part for part in PARTS if part not in config.parts or (part == "photos" and config.photos is None)]
    if left_out:
        warnings.append(f"Parts left out: {', '.join(left_out)}.")
    if config.is_finished:
        warnings.append("Each row has as many tasks as are finished, and says how many.")
    if unfinished:
        warnings.append(f"Sections left out, with too few finished tasks: {'; '.join(unfinished)}.")
    return warnings


def _section_parts(measured: Sequence[MeasuredSection]) -> list[PagePart]:
    methods = [section for section in measured if section.section.name == "methods"]
    parts: list[PagePart] = []
    for section in measured:
        about, text, charts = section.section, section.section.text, list[Chart | Bars]()
        if about.name != "methods":
            figures = {cell.label: cell.figures for cell in section.cells}
            bars = [Bar(name, f["success_tight"], *f["success_tight_interval"]) for name, f in figures.items()]
            charts.append(Bars("Within 2 cm and 0.1 rad", _SHARE, bars))
        elif section is methods[0]:  # all charts and texts stand at the first number of objects
            labels = {cell.label for one in methods for cell in one.cells}
            text += "\n" + " ".join(words for label, words in _METHOD_TEXTS.items() if label in labels)
            charts += [_success_chart(one) for one in methods]
        else:
            text = "The same methods with other tasks. Their curves stand above."
        if about.left_out:
            text += f"\nLeft out, with no finished tasks: {', '.join(about.left_out)}."
        parts.append(PagePart(about.title, text, charts, [], _HEADS, rows_of(section)))
    return parts
