"""Which stages of an episode are the paper's, and their models: one by one, or all together."""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Literal, get_args

import numpy as np
from jaxtyping import Float

from osfcore.control.estimators import Estimators, SceneModels
from osfcore.estimation.objective import ObjectModels
from osfcore.estimation.steps import EstimateStep
from osfcore.fields.field_library import FieldLibrary
from osfcore.geometry.states import Observation, SceneState
from osfcore.paper.dynamics import load_paper_push_model
from osfcore.paper.estimation import PaperEstimationConfig, estimate_first, estimate_next
from osfcore.paper.fields import TinyField, read_field
from osfcore.paper.method import paper_field_path
from osfcore.paper.rendering import PaperRenderer

StageName = Literal["fields", "estimation", "dynamics", "planning"]
STAGES: tuple[StageName, ...] = get_args(StageName)


@dataclass(frozen=True)
class PaperEstimators(Estimators):
    """CMA-ES alone for poses and light. Goal images, which the paper never inverts, are estimated as ours are.

    Attributes:
        cma: how much work it is.
    """

    cma: PaperEstimationConfig = field(default_factory=PaperEstimationConfig)

    def first_frame(
        self, models: ObjectModels, observation: Observation, rng: np.random.Generator
    ) -> Iterator[EstimateStep]:
        """Estimate poses and light in the first frame, which has masks."""
        return estimate_first(models, observation, rng, self.cma)

    def later_frame(
        self,
        models: ObjectModels,
        observation: Observation,
        expected: SceneState,
        rng: np.random.Generator,
        usual: Float[np.ndarray, "N"] | None = None,
    ) -> Iterator[EstimateStep]:
        """Estimate poses in a later frame, under the light of the last estimate."""
        return estimate_next(models, observation, expected, rng, self.cma)


def load_paper_appearance(names: Iterable[str], fields: FieldLibrary, data_dir: Path | None) -> ObjectModels:
    """Return how objects look by their KiloOSFs as published, on the table of ours.

    Args:
        names: of the objects.
        fields: library of the table.
        data_dir: whose fields come before the installed ones.

    Raises:
        UnknownName: if an object has no such field.
        CorruptFile: if a file is broken.
    """
    own: dict[str, TinyField] = {name: read_field(paper_field_path(name, data_dir)) for name in names}
    return ObjectModels.rendered_by(PaperRenderer, own, fields.load_table())


def with_paper_stages(
    models: SceneModels, stages: frozenset[str], fields: FieldLibrary, data_dir: Path | None
) -> SceneModels:
    """Return models of which some are the paper's.

    Args:
        models: ours, of a scene's objects.
        stages: which of "fields" and "dynamics" to replace; others have no models.
        fields: library of the fields.
        data_dir: whose files come before the installed ones.

    Raises:
        UnknownName: if an object has no such field.
        CorruptFile: if a file is broken.
    """
    names = tuple(models.shapes)
    appearance = load_paper_appearance(names, fields, data_dir) if "fields" in stages else models.appearance
    dynamics = load_paper_push_model(data_dir, fields, names) if "dynamics" in stages else models.dynamics
    return replace(models, appearance=appearance, dynamics=dynamics)
