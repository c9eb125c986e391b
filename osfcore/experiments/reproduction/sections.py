"""Which episodes the report shows: sections of cells, each of which is one method on one set of tasks.

All cells with the same family and number of objects get the same tasks, so that any two can be compared task by task.
Cells that stand in several sections, such as ours in the usual world, are measured once.
"""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from typing import Literal, NamedTuple, get_args

from osfcore.control.events import EpisodeSettings
from osfcore.experiments.factors import EPISODE_FACTORS
from osfcore.experiments.rearrangement import EvaluateMpc
from osfcore.experiments.rearrangement_runs import TRUTHS, Variant
from osfcore.experiments.rivals.visual_foresight import ForesightSettings
from osfcore.paper.mppi import STEPS, GaussianPlanSettings
from osfcore.paper.stages import StageName
from osfcore.planning.mppi import PlanSettings
from osfcore.world.tasks import Family

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
        scenes: that fields are compared on.
        videos: that predictions are compared on.
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
    scenes: int = 20
    videos: int = 20
    has_slow_cells: bool = True


_FEW = EpisodeSettings(steps=12, plan=PlanSettings(samples=32, horizon=10))
QUICK = Scale(
    tasks=3, headline=3, counts=(1,), objects=1, settings=_FEW, published=GaussianPlanSettings(48, 8),
    foresight=ForesightSettings(8, 6), factors=("light_low",), families=(), scenes=3,
    videos=3, has_slow_cells=False,
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
    makers = {
        "methods": _methods, "families": _families, "ablations": _ablations, "ladder": _ladder, "factors": _factors,
        "attribution": _attribution,
    }  # fmt: skip
    sections = [section for name in SECTIONS if name in chosen for section in makers[name](base, scale)]
    return tuple(section for section in sections if len(section.cells) > 1)


def _methods(base: EvaluateMpc, scale: Scale) -> list[Section]:
    sections = []
    for count in scale.counts:
        tasks = scale.headline if count == scale.objects else scale.tasks
        given = replace(base, objects=count, tasks=tasks, oracle=count == scale.objects)
        cells = [
            Cell(label, replace(given, variant=variant, oracle=given.oracle and label == "ours"))
            for label, variant in _METHODS.items()
            if scale.has_slow_cells or variant.method != "overhead"
        ]
        title = f"Success by threshold, {objects_in_words(count)} (Fig. 7)"
        text = (
            "Closed loops toward a goal image. All methods get the same tasks, and masks in the first frame alone, "
            "also the one as published, whose own evaluation has them at every step (below, under ablations). "
            "Compositional NeRFs and the two lights take the place of our fields and our estimate of the light in our "
            "loop. Ours refuses goals that it doubts, and fails there; others refuse none: what our doubts would have "
            "refused is counted beside them. Visual foresight has a FitVid of 7.4 million parameters, which learned "
            "for 45 minutes on one core; this says little of the original's 302 million."
        )
        sections.append(Section("methods", title, text, tuple(cells)))
    return sections


def _families(base: EvaluateMpc, scale: Scale) -> list[Section]:
    cells = [Cell(f"goals {family}", replace(base, family=family)) for family in ("shifted", *scale.families)]
    text = "Harder goals: turned as well, in one another's places, photographed under another light."
    return [Section("families", "Families of tasks", text, tuple(cells))]


def _ablations(base: EvaluateMpc, scale: Scale) -> list[Section]:
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
    return [Section("ablations", "Ablations", text, tuple(cells))]


def _ladder(base: EvaluateMpc, scale: Scale) -> list[Section]:
    cells = [Cell("as published", replace(base, variant=Variant("paper")))]
    for count in range(1, len(_LADDER) - (not scale.has_slow_cells)):
        variant = Variant("paper", frozenset(_LADDER[:count]))
        cells.append(Cell(f"+ our {_LADDER[count - 1]}", replace(base, variant=variant)))
    last = _LADDER[len(cells) - 1 :]
    cells.append(Cell(f"+ our {' and '.join(last)} = ours", base))
    text = "From the method as published to ours, one stage after another; each row keeps what those above it changed."
    return [Section("ladder", "The ladder", text, tuple(cells))]


def _factors(base: EvaluateMpc, scale: Scale) -> list[Section]:
    cells = [Cell("usual world", base)] + [Cell(name, replace(base, factor=name)) for name in scale.factors]
    text = "One thing differs from what the method takes for granted, and it is not told."
    return [Section("factors", "Factors of variation", text, tuple(cells))]


def _attribution(base: EvaluateMpc, _scale: Scale) -> list[Section]:
    cells = [Cell("ours", base), Cell("true light", replace(base, variant=Variant("known_light")))]
    cells += [Cell(f"true {truth}", replace(base, variant=Variant(truths=frozenset({truth})))) for truth in TRUTHS]
    cells.append(Cell("all true", replace(base, variant=Variant(truths=frozenset(TRUTHS)))))
    text = "Each stage in turn is replaced by the truth: what its errors cost."
    return [Section("attribution", "Where episodes fail", text, tuple(cells))]
