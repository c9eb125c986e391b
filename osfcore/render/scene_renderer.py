"""The fast path: whole batches of scenes from several cameras in one call."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import numpy as np
from jaxtyping import Bool

from osfcore.errors import InvalidInput
from osfcore.fields.kiloosf import KiloOSF
from osfcore.fields.table_field import TableField
from osfcore.geometry.cameras import Camera
from osfcore.render.packing import Packed, pack
from osfcore.render.solids import pusher_field
from osfcore.render.types import EXACT, Quality, Rendered, SceneBatch, check_request

_MOST_PACKS = 8


class SceneRenderer:
    """Renders scenes of known fields.

    Volume rendering after paper eq. 3, weighted by density; shadows of objects and pusher fall on each other and on the
    table with soft transmittance along the way to the light. An object does not shade itself here: its field already
    holds that.
    """

    def __init__(self, fields: Mapping[str, KiloOSF], table: TableField | None, *, device: str = "cpu") -> None:
        """Prepare fields.

        Args:
            fields: by name.
            table: None for black surroundings.
            device: "cpu" for compiled code on all cores, "cuda" for PyTorch on a GPU, "auto" for a GPU if there is one.

        Raises:
            InvalidInput: if there is no such device.
        """
        self._fields = dict(fields)
        self._table = table
        self._device = device
        if device != "cpu":
            from osfcore.fields.devices import pick_device

            self._device = pick_device(device).type
        self._packs: dict[tuple[tuple[str, ...], bool], tuple[Packed, np.ndarray]] = {}

    @property
    def names(self) -> tuple[str, ...]:
        """Objects that can be drawn."""
        return tuple(self._fields)

    def render(
        self,
        batch: SceneBatch,
        cameras: Sequence[Camera],
        *,
        quality: Quality = EXACT,
        outputs: frozenset[str] | set[str] = frozenset({"rgb"}),
        only: Bool[np.ndarray, "V h w"] | None = None,
    ) -> Rendered:
        """Images of every scene of a batch from every camera.

        Args:
            batch: B scenes.
            cameras: V cameras of one image size.
            quality: `EXACT` or `PLANNING`, or anything between.
            outputs: which of "rgb", "opacity", "masks", "depth"; colours always come.
            only: pixels to look at; all others stay black and empty.

        Raises:
            UnknownName: if an object has no field here.
            InvalidInput: if cameras differ in size, an output is unknown, or `only` is of another shape.
        """
        size = check_request(self._fields, batch, cameras, outputs)
        if only is not None and only.shape != (len(cameras), *size):
            raise InvalidInput("shape of the pixels to look at", only.shape, f"{(len(cameras), *size)}")
        if self._device != "cpu":
            from osfcore.render.reference import render_on_device  # torch: seconds, and only a GPU needs it

            return render_on_device(self._fields, self._table, batch, cameras, self._device, quality, outputs, only)
        from osfcore.render.launch import launch  # compiles; the web process only names renderers

        pack, numbers = self._packed(batch)
        return launch(pack, numbers, self._table, batch, cameras, size, quality, outputs, only)

    def _packed(self, batch: SceneBatch) -> tuple[Packed, np.ndarray]:
        """The batch's fields, each packed once, and which of them each object has."""
        key = (batch.names, batch.pusher is not None)
        packed = self._packs.get(key)
        if packed is None:
            if len(self._packs) > _MOST_PACKS:  # a viewer that goes through many scenes must not keep them all
                self._packs.clear()
            names = list(dict.fromkeys(batch.names))
            fields = [self._fields[name] for name in names]
            numbers = [names.index(name) for name in batch.names]
            if batch.pusher is not None or not fields:
                hidden = fields[0].hidden if fields else 1
                fields.append(pusher_field(hidden))
            if batch.pusher is not None:
                numbers.append(len(fields) - 1)
            packed = pack(fields), np.array(numbers, np.int64)
            self._packs[key] = packed
        return packed
