"""What is known before any image: how each object looks, how it can lie, and how the table looks."""

from __future__ import annotations

from collections.abc import Mapping

from osfcore.errors import UnknownName
from osfcore.estimation.objective.resting_orientations import RestingOrientations, resting_orientations
from osfcore.fields.kiloosf import KiloOSF
from osfcore.fields.table_field import TableField
from osfcore.render.scene_renderer import SceneRenderer
from osfcore.render.types import PLANNING, Quality

QUALITY: Quality = PLANNING


class ObjectModels:
    """Fields of the objects, and two renderers of them: alone over black, and together on the table."""

    def __init__(self, fields: Mapping[str, KiloOSF], table: TableField, *, device: str = "cpu") -> None:
        """Prepare fields.

        Args:
            fields: by name of the object.
            table: what the objects lie on.
            device: where images are rendered, see `SceneRenderer`.

        Raises:
            InvalidInput: if there is no such device.
        """
        self._fields = dict(fields)
        self._resting: dict[str, RestingOrientations] = {}
        self.alone = SceneRenderer(fields, None, device=device)
        self.together = SceneRenderer(fields, table, device=device)

    def check(self, names: tuple[str, ...]) -> None:
        """Refuse objects without a field.

        Raises:
            UnknownName: if one has none.
        """
        for name in names:
            if name not in self._fields:
                raise UnknownName("field", name, sorted(self._fields))

    def resting(self, name: str) -> RestingOrientations:
        """How an object can lie on a table, found when first asked for."""
        if name not in self._resting:
            self.check((name,))
            self._resting[name] = resting_orientations(self._fields[name])
        return self._resting[name]
