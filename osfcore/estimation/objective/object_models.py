"""What is known before any image: how each object looks, how it can lie, and how the table looks."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping
from typing import TypeVar

import numpy as np
from jaxtyping import Float

from osfcore.errors import UnknownName
from osfcore.estimation.objective.resting_orientations import DensityGrid, RestingOrientations, resting_orientations
from osfcore.fields.kiloosf import KiloOSF
from osfcore.fields.table_field import TableField
from osfcore.metrics.pose_errors import rotation_error
from osfcore.objects.asset import Symmetry
from osfcore.render.scene_renderer import SceneRenderer
from osfcore.render.types import PLANNING, Quality, Renderer

QUALITY: Quality = PLANNING
FieldT = TypeVar("FieldT", bound=DensityGrid)


class ObjectModels:
    """Fields of the objects, and two renderers of them: alone over black, and together on the table."""

    def __init__(
        self,
        fields: Mapping[str, KiloOSF],
        table: TableField,
        *,
        device: str = "cpu",
        symmetries: Mapping[str, Symmetry] | None = None,
    ) -> None:
        """Prepare fields.

        Args:
            fields: by name of the object.
            table: what the objects lie on.
            device: where images are rendered, see `SceneRenderer`.
            symmetries: which orientations of an object look the same; none of those left out.

        Raises:
            InvalidInput: if there is no such device.
        """
        alone, together = (SceneRenderer(fields, ground, device=device) for ground in (None, table))
        self._set(fields, alone, together)
        self._changeable = fields, table, device
        self._symmetries = dict(symmetries or {})

    @classmethod
    def rendered_by(
        cls,
        renderer: Callable[[Mapping[str, FieldT], TableField | None], Renderer],
        fields: Mapping[str, FieldT],
        table: TableField,
    ) -> ObjectModels:
        """Models whose fields another renderer draws.

        Args:
            renderer: makes renderers of fields, on a table or over black.
            fields: by name of the object.
            table: what the objects lie on.
        """
        models = cls.__new__(cls)
        models._set(fields, renderer(fields, None), renderer(fields, table))
        return models

    def _set(self, fields: Mapping[str, DensityGrid], alone: Renderer, together: Renderer) -> None:
        self._fields = dict(fields)
        self._resting: dict[str, RestingOrientations] = {}
        self._symmetries: dict[str, Symmetry] = {}
        self._changeable: tuple[Mapping[str, KiloOSF], TableField, str] | None = None
        self.alone, self.together = alone, together

    @property
    def can_change(self) -> bool:
        """Whether `changed` works: not where another renderer draws fields of its own kind."""
        return self._changeable is not None

    def changed(
        self, names: Iterable[str], field: Callable[[KiloOSF], KiloOSF], table: Callable[[TableField], TableField]
    ) -> ObjectModels:
        """Models of some of the objects with another look and the same shapes.

        Args:
            names: of the objects.
            field: from a field to the one in its place, of the same density.
            table: likewise of the table.
        """
        assert self._changeable is not None, "can_change tells"
        fields, ground, device = self._changeable
        changed = {name: field(fields[name]) for name in names}
        models = ObjectModels(changed, table(ground), device=device, symmetries=self._symmetries)
        models._resting = {name: self.resting(name) for name in names}
        return models

    def check(self, names: tuple[str, ...]) -> None:
        """Refuse objects without a field.

        Raises:
            UnknownName: if one has none.
        """
        for name in names:
            if name not in self._fields:
                raise UnknownName("field", name, sorted(self._fields))

    def turned(
        self, name: str, one: Float[np.ndarray, "4"], others: Float[np.ndarray, "B 4"]
    ) -> Float[np.ndarray, "B"]:
        """Angles between an object's orientations [rad], over all that look like `one`."""
        symmetry = self._symmetries.get(name, Symmetry("none"))
        return np.array([rotation_error(symmetry, other, one) for other in others])

    def resting(self, name: str) -> RestingOrientations:
        """How an object can lie on a table, found when first asked for."""
        if name not in self._resting:
            self.check((name,))
            self._resting[name] = resting_orientations(self._fields[name])
        return self._resting[name]
