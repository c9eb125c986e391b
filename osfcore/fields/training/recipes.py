"""What a training of a KiloOSF is told: its settings and its recipe."""

from __future__ import annotations

import time
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Literal

from osfcore.fields.training.optimization import Rates

_COARSE_RATES = Rates(2e-2, 1e-2)


_FINE_RATES = Rates(2e-2, 1e-3)


@dataclass(frozen=True, slots=True)
class Recipe:
    """How a field is trained; docs/fields.md has the measurements behind the numbers.

    Attributes:
        coarse_across: voxels along the longest side in the first phase.
        fine_across: the same in the second.
        coarse_share: of the time budget.
        cells: tiny networks along the longest side.
        hidden: their width.
        rays: pixels per step of descent.
        solid_g: density feature inside the visual hull at first.
        hollow_across: instead of coarse_across for hollow objects: views agree on fine surfaces.
        hollow_g: density feature of the fog around the surfaces on which views agree, from which edges grow.
        hollow_steps: of descent without networks, before the first phase of a hollow object.
        hollow_share: instead of coarse_share for hollow objects: opening a hollow takes time.
        coarse_rates: learning rates of the first phase.
        fine_rates: of the second.
        teacher_share: of the time budget, in recipe "distil".
        distil_share: likewise.
    """

    coarse_across: int = 48
    fine_across: int = 96
    coarse_share: float = 0.15
    cells: int = 8
    hidden: int = 16
    rays: int = 4096
    solid_g: float = 6.0
    hollow_across: int = 96
    hollow_g: float = -5.5
    hollow_steps: int = 400
    hollow_share: float = 0.3
    coarse_rates: Rates = _COARSE_RATES
    fine_rates: Rates = _FINE_RATES
    teacher_share: float = 0.45
    distil_share: float = 0.1


@dataclass(frozen=True, slots=True)
class Pace:
    """How often a training that runs is heard of; no matter to what it learns.

    Attributes:
        report_s: between two steps that are told [s].
        checkpoint_s: between two checkpoints [s].
        clock: tells the time that counts for both and for the budget [s].
    """

    report_s: float = 1.0
    checkpoint_s: float = 20.0
    clock: Callable[[], float] = time.monotonic


@dataclass(frozen=True, slots=True)
class TrainField:
    """A training run.

    Attributes:
        data: image set in the OSF format; `train` is learned from, `test` measured on.
        out: file to write, FILE.safetensors; metrics go beside it to FILE.json.
        minutes: time budget of the descent [min].
        device: "auto", "cpu" or "cuda".
        seed: of everything random.
        iterations: instead of the time budget, that many steps: repeatable on one machine.
        hollow: the object has hollows that no silhouette shows, such as a bowl's; "direct" only.
        recipe: "direct", or "distil" for the paper's way over a teacher.
        teacher_width: units of each layer of the teacher.
        teacher_depth: its layers.
        lit: False for colours that do not depend on the light, as a NeRF's, to compare with; "direct" only.
    """

    data: Path
    out: Path
    minutes: float = 30.0
    device: Literal["auto", "cpu", "cuda"] = "auto"
    seed: int = 0
    iterations: int | None = None
    hollow: bool = False
    recipe: Literal["direct", "distil"] = "direct"
    teacher_width: int = 64
    teacher_depth: int = 4
    lit: bool = True
