"""`osf reproduce`: the paper's experiments, with its rivals and what else there is to know, in one report."""

from __future__ import annotations

import base64
from collections.abc import Callable, Generator, Iterator, Mapping, Sequence
from concurrent.futures import Executor
from dataclasses import asdict, dataclass, field, replace
from importlib.resources import files
from pathlib import Path
from typing import Any, Literal, NamedTuple, get_args

import numpy as np

from osfcore.control.events import EpisodeSettings
from osfcore.errors import InvalidInput, check_seed
from osfcore.experiments import relighting, unrolled_estimation, video_prediction
from osfcore.experiments.charts import Axis, Bar, Chart, Curve, write_bars, write_charts
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
    """

    name: SectionName
    title: str
    text: str
    cells: tuple[Cell, ...]


def objects_in_words(count: int) -> str:
    """Return words such as "1 object"."""
    return f"{count} object{'s' * (count > 1)}"


def _objects(figures: Mapping[str, Any]) -> str:
    """Return how many objects a cell's tasks have, and how they stand, in words."""
    return objects_in_words(figures["objects"]) + " that stand upright" * (figures["family"] == "upright")


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
    harder = "Harder goals: turned as well, in one another's places, photographed under another light."
    differing = "One thing differs from what the method takes for granted, and it is not told."
    replaced = "Each stage in turn is replaced by the truth: what its errors cost."
    sections = (
        *_methods(base, scale),
        Section("families", "Families of tasks", harder, tuple(families)),
        _ablations(base, scale),
        _ladder(base, scale),
        Section("factors", "Factors of variation", differing, tuple(factors)),
        Section("attribution", "Where episodes fail", replaced, tuple(attributed)),
    )
    return tuple(section for section in sections if section.name in chosen and len(section.cells) > 1)


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
        title = f"Success by threshold, {_objects({'objects': count, 'family': family})} (Fig. 7)"
        text = (
            "Closed loops toward a goal image. All methods get the same tasks, and masks in the first frame alone, "
            "also the one as published, whose own evaluation has them at every step (below, under ablations). "
            "Compositional NeRFs and the two lights take the place of our fields and our estimate of the light in our "
            "loop. Ours refuses goals that it doubts, and fails there; others refuse none: what our doubts would have "
            "refused is counted beside them. Visual foresight has a FitVid of 4.0 million parameters, told where the "
            "pusher is, which learned for 50 minutes on one core; this says little of the original's 302 million."
        )
        sections.append(Section("methods", title, text, tuple(cells)))
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
        "Masks are given in the first frame alone, but for the last row: the paper's evaluation has them at every step."
    )
    return Section("ablations", "Ablations", text, tuple(cells))


def _ladder(base: EvaluateMpc, scale: Scale) -> Section:
    cells = [Cell("as published", replace(base, variant=Variant("paper")))]
    for count in range(1, len(_LADDER) - (not scale.has_slow_cells)):
        variant = Variant("paper", frozenset(_LADDER[:count]))
        cells.append(Cell(f"+ our {_LADDER[count - 1]}", replace(base, variant=variant)))
    last = _LADDER[len(cells) - 1 :]
    cells.append(Cell(f"+ our {' and '.join(last)} = ours", base))
    text = "From the method as published to ours, one stage after another; each row keeps what those above it changed."
    return Section("ladder", "The ladder", text, tuple(cells))


# Measuring the cells of a report side by side, and what their results say next to each other.

Steps = Iterator[EvaluationStep[dict[str, Any]]]


class MeasuredCell(NamedTuple):
    """Results of a cell.

    Attributes:
        label: in tables and charts.
        report: all results.
        figures: of the report, as plain JSON.
        against: comparison with the section's first cell, task by task; None for that cell itself and for other tasks.
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
                against = paired(report.shipped, cells[0].report.shipped)
            cells.append(MeasuredCell(label, report, figures_of(config, report), against))
        measured.append(MeasuredSection(section, tuple(cells)))
    return measured


def _tasks_of(config: EvaluateMpc) -> tuple[str, int, int]:
    """Return what a cell's tasks depend on: families differ in them, but for the light of the goal image."""
    return config.family.replace("relit", "shifted"), config.objects, config.tasks


# The report as one HTML file that needs nothing beside it.


_TEMPLATE = "page.html.jinja"


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
        text: under the title.
        pictures: PNGs with what they show, in words.
        heads: of the table's columns.
        rows: of the table, words as they stand there.
    """

    title: str
    text: str
    pictures: Sequence[tuple[Path, str]]
    heads: Sequence[str]
    rows: Sequence[Sequence[str]]


def write_page(
    path: Path, about: About, warnings: Sequence[str], findings: Sequence[str], parts: Sequence[PagePart]
) -> None:
    """Write the report; its pictures become part of it.

    Args:
        path: of the HTML file.
        about: circumstances of the report.
        warnings: what a reader must know first.
        findings: in sentences.
        parts: from top to bottom.

    Raises:
        CannotWrite: if the disk refuses.
        MissingExtra: if jinja2 is not installed.
    """
    need("experiments", "The report")
    import jinja2

    template = (files("osfcore.experiments.reproduction") / _TEMPLATE).read_text(encoding="utf-8")
    environment = jinja2.Environment(autoescape=True, trim_blocks=True, undefined=jinja2.StrictUndefined)
    given = {"about": about, "warnings": warnings, "findings": findings, "parts": parts}
    given["data_url"] = lambda picture: f"data:image/png;base64,{base64.b64encode(picture.read_bytes()).decode()}"
    write_atomically(path, environment.from_string(template).render(given).encode())


# Charts of a report's sections.


_POINTS = 61
_SHARE = Axis("share of tasks", 0, 1)
_DISTANCE = Axis("6D pose distance, symmetries counted", 0, 0.6)


def _success_chart(section: MeasuredSection) -> Chart:
    """Draw success against threshold, for one number of objects (paper, figure 7)."""
    first = section.cells[0]
    kinds = {cell.label: cell.report.shipped for cell in section.cells} | {"no action": first.report.nothing}
    if first.report.oracle:
        kinds["told the truth"] = first.report.told_truth
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
_HALF = 0.5


def findings(sections: Sequence[MeasuredSection]) -> list[str]:
    """Return a sentence for each comparison of the methods, for the mean distance, and for what costs too much."""
    methods = [section for section in sections if section.section.name == "methods"]
    comparisons = [
        (section.cells[0], cell, key) for section in methods for cell in section.cells[1:] for key in _COMPARED
    ]
    corrected = holm([_gap(cell, key)["p"] for _, cell, key in comparisons])
    sentences = [_method(*one, p) for one, p in zip(comparisons, corrected, strict=True)]
    for section in methods:
        ours = section.cells[0]
        mean, nothing = (ours.figures[f"{who}pose6d_symmetric_mean"] for who in ("", "noaction_"))
        sentences.append(
            f"{_objects(ours.figures)}: mean 6D pose distance, symmetries counted, {mean:.3f}; doing nothing "
            f"{nothing:.3f}: {'at most' if mean <= _HALF * nothing else 'more than'} half."
        )
    for cell in (cell for section in sections if section.section.name == "factors" for cell in section.cells[1:]):
        lost, low, high = _lead(cell, "success_tight")
        if -_gap(cell, "success_tight")["difference"] > MOST_LOST:
            sentences.append(
                f"Under {cell.label} {lost:.0f} points of success are lost (95 %: {low:.0f} to "
                f"{high:.0f}), more than {100 * MOST_LOST:.0f}."
            )
    return sentences


def _gap(cell: MeasuredCell, key: str) -> Mapping[str, Any]:
    """Return how a cell differs from the first of its section; all methods and all factors have the same tasks."""
    return (cell.against or {})[key]


def _lead(cell: MeasuredCell, key: str) -> tuple[float, float, float]:
    """Return by how much the first cell is ahead of another one, and the interval [percent]."""
    gap = _gap(cell, key)  # the other one minus the first
    low, high = (-100 * end for end in reversed(gap["interval"]))
    return 100 * (0.0 - gap["difference"]), low, high  # never -0


def _method(ours: MeasuredCell, other: MeasuredCell, key: str, corrected: float) -> str:
    """Compare ours with another method; who is better is said where p, corrected for all comparisons, is below 5 %."""
    lead, low, high = _lead(other, key)
    better = "ours is better" if lead > 0 else "ours is worse"
    verdict = better if corrected < _SIGNIFICANT else "no difference is shown"
    return (
        f"{_objects(ours.figures)}, ours and {other.label}, {_COMPARED[key]}: {100 * ours.figures[key]:.0f} % against "
        f"{100 * other.figures[key]:.0f} %, which is {lead:+.0f} points (95 %: {low:+.0f} to {high:+.0f}; "
        f"McNemar p = {_gap(other, key)['p']:.2g}, {corrected:.2g} by Holm for all these comparisons): {verdict}."
    )


_HEADS = (
    "", "tasks", "2 cm and 0.1 rad", "2 cm", "refused", "6D mean", "with symmetry", "its median", "first frame [mm]",
    "[deg]", "light [deg]", "points against the first row",
)  # fmt: skip


def rows_of(section: MeasuredSection) -> list[list[str]]:
    """Return the rows of a section's table, those of the oracle and of doing nothing among them, as plain words."""
    rows = [_row(cell.label, cell.figures, "", cell) for cell in section.cells]
    first = section.cells[0]
    if first.report.oracle:
        rows.append(_row("told the truth", first.figures, "oracle_"))
    rows.append(_row("no action", first.figures, "noaction_"))
    return rows


def _row(label: str, figures: Mapping[str, Any], who: str, cell: MeasuredCell | None = None) -> list[str]:
    shares = []
    for key in _COMPARED:
        low, high = figures[f"{who}{key}_interval"]
        shares.append(f"{100 * figures[who + key]:.0f} % ({100 * low:.0f} to {100 * high:.0f})")
    distances = ("pose6d_mean", "pose6d_symmetric_mean", "pose6d_symmetric_median")
    refused, errors, gap = "", ["", "", ""], ""
    if cell is not None:
        refused = str(figures["refused"])
        medians = [figures[f"{key}_median"] for key in ("first_mm", "first_deg", "light_deg")]
        errors = ["" if value is None else f"{value:.2f}" for value in medians]
        if cell.against is not None:
            ahead = cell.against["success_tight"]
            low, high = ahead["interval"]
            gap = f"{100 * ahead['difference']:+.0f} ({100 * low:+.0f} to {100 * high:+.0f}), p = {ahead['p']:.2g}"
    six_d = [f"{figures[who + key]:.3f}" for key in distances]
    return [label, str(figures["tasks"]), *shares, refused, *six_d, *errors, gap]


# The parts of a report before the episodes, each of one evaluation.


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
        f"First frames of {objects_in_words(report['objects'])}: {report['tasks']}, medians. The published estimation "
        "holds the light overhead for its first five iterations; ours reads it off the table's shadows early on. The "
        "green cube is where the light is taken to be, the white frame where it is."
    )
    pictures = (
        (
            folder / unrolled_estimation.IMAGES_FILE,
            "One frame at five moments of its estimate, near and far, by each method",
        ),
        (folder / unrolled_estimation.CHART_FILE, "Errors of positions, rotations and light along the estimate"),
    )
    return PagePart("An estimate as it runs (Figs. 2 and 3)", text, pictures, ("", "moment", *titles.values()), rows)


def dynamics_part(folder: Path, reports: Mapping[str, Mapping[str, Any]]) -> PagePart:
    """Return the part on predicted poses.

    Args:
        folder: with the pictures.
        reports: of `evaluate_dynamics`, by method.
    """
    horizons = (4, 10, 30)
    heads = [f"{horizon} steps [{unit}]" for horizon in horizons for unit in ("mm", "deg")]
    rows = []
    for method, report in reports.items():
        cells = [report[f"median_{unit}_{horizon}"] for horizon in horizons for unit in ("mm", "deg")]
        rows.append([TITLES[method], *("-" if cell is None else f"{cell:.3g}" for cell in cells)])
    still = next(iter(reports.values()))
    cells = [still[f"constant_{unit}_{horizon}"] for horizon in horizons for unit in ("mm", "deg")]
    rows.append(["no motion", *("-" if cell is None else f"{cell:.3g}" for cell in cells)])
    text = (
        f"Medians over objects that moved, {still['windows']} within four actions, in episodes that no network learned "
        "from and that chose nothing: half of them seek contact, half are the paper's random ones. True poses and "
        "actions are given."
    )
    pictures = [
        (folder / ("" if method == "ours" else method) / "dynamics.png", f"Errors by horizon, {TITLES[method]}")
        for method in reports
    ]
    return PagePart("Predicted poses (sec. 4.3)", text, pictures, ("", *heads), rows)


def photos_part(folder: Path, reports: Mapping[str, Mapping[str, Any]]) -> PagePart:
    """Return the part on photographs.

    Args:
        folder: with a folder of contact sheets for each start.
        reports: of `evaluate_photos`, by what searches begin with.
    """
    heads = ("starts", "photograph", "object", "IoU", "position [mm]", "rotation [deg]", "doubted")
    rows, pictures = [], []
    for start, report in reports.items():
        for score in report["scores"]:
            errors = ("-" if score[key] is None else f"{score[key]:.1f}" for key in ("position_mm", "rotation_deg"))
            about = "yes" if score["doubt"] else ""
            rows.append([start, score["scene"], score["name"], f"{score['iou']:.3f}", *errors, about])
        sheets = sorted((folder / start).glob("*.png"))
        pictures += [(sheet, f"{sheet.stem}: photograph, pose, difference; starts {start}") for sheet in sheets]
    lamps = {name: errors for report in reports.values() for name, errors in report["light_deg"].items()}
    rows += [["", name, "lamp", "", "", f"{np.median(errors):.1f}", ""] for name, errors in lamps.items()]
    text = (
        "Objects in real photographs, given their masks, from no start and from every other source of poses there is. "
        "Errors are from the truth where it is known, else from poses that were refined with measured depth. Lamps: "
        "median angle between estimated and true direction."
    )
    return PagePart("Real photographs (Fig. 8)", text, pictures, heads, rows)


def relighting_part(folder: Path, report: Mapping[str, Any]) -> PagePart:
    """Return the part on scenes under lights of all elevations.

    Args:
        folder: with the pictures.
        report: of `compare_relighting`.
    """
    titles = {"psnr": "PSNR [dB]", "ssim": "SSIM", "psnr_object": "on objects [dB]", "psnr_shadow": "in shadow [dB]"}
    columns = [(key, relighting.ALL, title) for key, title in titles.items()]
    text = (
        f"{report['tasks']} scenes of {objects_in_words(report['objects'])}, poses and light given, under lights "
        f"between {min(report['elevations_deg']):g} and {max(report['elevations_deg']):g} deg above the table."
    )
    pictures = (
        (folder / relighting.CHART_FILE, "PSNR and SSIM by elevation of the light"),
        (folder / relighting.IMAGES_FILE, "One scene under a low, a middle and a high light, by each method"),
    )
    return PagePart("Scenes under any light (Fig. 5)", text, pictures, *_table(report, columns))


def video_part(folder: Path, report: Mapping[str, Any]) -> PagePart:
    """Return the part on pushes predicted as images.

    Args:
        folder: with the pictures.
        report: of `compare_videos`.
    """
    spans, titles = next(iter(report["methods"].values()))["psnr"]["spans"], {"psnr": "PSNR [dB]", "ssim": "SSIM"}
    columns = [(key, span, f"{title}, {span} steps") for span in spans for key, title in titles.items()]
    text = (
        f"{report['tasks']} episodes of {objects_in_words(report['objects'])}, {report['steps']} actions known "
        "in advance, from the first frame's estimate; FitVid sees two frames of the goal camera."
    )
    pictures = (
        (folder / video_prediction.CHART_FILE, "PSNR and SSIM by predicted step"),
        (folder / video_prediction.IMAGES_FILE, "One episode as it was and as each method predicts it"),
    )
    return PagePart("Predicted futures as images (Fig. 6)", text, pictures, *_table(report, columns))


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


PAGE_FILE, FIGURES_FILE = "report.html", "reproduction.json"
_CURVES = "success.png"
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
        folder: for report.html, reproduction.json, pictures, and all results.
        data_dir: where objects, fields and networks of this machine are.
        about: circumstances, as the page shows them; the names are filled in.
        scale: how much is measured.
        is_quick: whether the page must warn that it is little.
        parts: of the report.
        names: objects to draw from; those that all methods have a field of if None.
        photos: folder of photographs as `evaluate_photos` takes them; without one their part is left out.
    """

    folder: Path
    data_dir: Path
    about: About
    scale: Scale
    is_quick: bool = False
    parts: tuple[PartName, ...] = PARTS
    names: tuple[str, ...] | None = None
    photos: Path | None = None


def reproduce(config: Reproduce, fields: FieldLibrary, assets: AssetLibrary, executor: Executor | None = None) -> Steps:
    """Measure what is not measured yet, and write the report.

    Args:
        config: what to measure.
        fields: of the objects.
        assets: meshes for the simulator.
        executor: runs pieces side by side, if given.

    Raises:
        UnknownName, MissingAssets: if an object lacks a field or a mesh.
        InvalidInput: if a number or name is out of range.
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
    measured = yield from measure_cells(sections_of(base, config.scale, chosen), fields, assets, executor)
    report = _figures(config, images, measured)
    write_json(config.folder / FIGURES_FILE, report)
    places = {"dynamics": config.folder / "dynamics", "photos": config.folder / "photos"}
    parts = [_EVALUATION_PARTS[name](places.get(name, config.folder), figures) for name, figures in images.items()]
    parts += _section_parts(config.folder, measured)
    write_page(config.folder / PAGE_FILE, config.about, _warnings(config), report["findings"], parts)
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


def _warnings(config: Reproduce) -> list[str]:
    """Return what a reader must know before anything else."""
    scale, warnings = config.scale, list[str]()
    if config.is_quick:
        warnings.append(
            f"A quick look and no measurement: {scale.tasks} tasks a cell, {scale.settings.steps} actions instead of "
            f"30, plans of {scale.settings.plan.samples} sequences, {objects_in_words(scale.objects)}, "
            f"and only the factor {', '.join(scale.factors)}. Cells that take "
            "longest are left out. Intervals are as wide as that makes them."
        )
    left_out = [part for part in PARTS if part not in config.parts or (part == "photos" and config.photos is None)]
    if left_out:
        warnings.append(f"Parts left out: {', '.join(left_out)}.")
    return warnings


def _section_parts(folder: Path, measured: Sequence[MeasuredSection]) -> list[PagePart]:
    methods = [section for section in measured if section.section.name == "methods"]
    parts: list[PagePart] = []
    for section in measured:
        about, pictures = section.section, list[tuple[Path, str]]()
        if about.name != "methods":
            picture, axis = folder / f"{about.name}.png", Axis("share of tasks within 2 cm and 0.1 rad", 0, 1)
            figures = {cell.label: cell.figures for cell in section.cells}
            bars = [Bar(name, f["success_tight"], *f["success_tight_interval"]) for name, f in figures.items()]
            write_bars(picture, about.title, axis, bars)
            pictures.append((picture, f"{about.title}: share of tasks within 2 cm and 0.1 rad"))
        elif section is methods[0]:  # one picture for all numbers of objects
            write_charts(folder / _CURVES, [_success_chart(one) for one in methods])
            pictures.append((folder / _CURVES, "Share of tasks within each 6D distance, for each number of objects"))
        parts.append(PagePart(about.title, about.text, pictures, _HEADS, rows_of(section)))
    return parts
