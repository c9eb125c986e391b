"""The paper's renderer: scenes of KiloOSFs as published, composed by eq. 3, with shadow maps.

It answers as `osfcore.render.scene_renderer.SceneRenderer` does. Readings of what the paper leaves open: table and
lamp are modelled as in ours; the pusher, a known part of the robot, is an exact cylinder; an object is left out of its
own shadow, since rho holds that already; and where the light is blocked, an object keeps the share of its radiance that
the table keeps there, for rho alone does not tell its ambient part.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import numpy as np
from jaxtyping import Bool

from osfcore.errors import InvalidInput
from osfcore.fields.ray_marching import ONE_AT_A_TIME
from osfcore.fields.table_field import TableField
from osfcore.geometry.cameras import Camera
from osfcore.geometry.light import AMBIENT
from osfcore.geometry.poses import quaternion_to_matrix
from osfcore.paper.fields.tiny_field import TinyField, network_size
from osfcore.paper.rendering.packing import PackedTiny, pack
from osfcore.render.types import EXACT, MASK_OPACITY, Quality, Rendered, SceneBatch, camera_numbers, check_request

_FINE_MAP, _COARSE_MAP = 96, 32  # sides of shadow maps [px]
_CORNERS = np.array(list(np.ndindex(2, 2, 2)), bool)


def _check_light_and_pixels(
    batch: SceneBatch, only: Bool[np.ndarray, "V h w"] | None, shape: tuple[int, int, int]
) -> None:
    if batch.spots is not None:
        raise InvalidInput("light of the published renderer", "a lamp at a finite distance", "a distant one")
    if only is not None and only.shape != shape:
        raise InvalidInput("shape of the pixels to look at", only.shape, f"{shape}")


class PaperRenderer:
    """Renders scenes of known fields.

    Args:
        fields: by name.
        table: None for black surroundings.
    """

    def __init__(self, fields: Mapping[str, TinyField], table: TableField | None) -> None:
        self._fields, self._table = dict(fields), table
        self._packs: dict[tuple[str, ...], tuple[PackedTiny, np.ndarray]] = {}

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
        """Images of every scene of a batch from every camera; arguments as for `SceneRenderer.render`.

        Raises:
            UnknownName: if an object has no field here.
            InvalidInput: if cameras differ in size, an output is unknown, `only` is of another shape, or there are
                near lamps.
        """
        size = check_request(self._fields, batch, cameras, outputs)
        _check_light_and_pixels(batch, only, (len(cameras), *size))
        from osfcore.paper.rendering.kernels import render_batch  # compiles
        from osfcore.paper.rendering.shadow_maps import shadow_maps
        from osfcore.render.launch import plain_table, screen_boxes, z_depth

        packed, numbers = self._packed(batch.names)
        rotations = np.swapaxes(quaternion_to_matrix(batch.quaternions), -1, -2)
        shape, count = (len(batch.lights), len(cameras), *size), len(batch.names)
        wants_opacity = bool({"opacity", "masks"} & set(outputs))
        rgb = np.empty((*shape, 3), np.float32)
        opacity = np.zeros((shape[0], shape[1], count, *size) if wants_opacity else (0,) * 5, np.float32)
        distance = np.empty(shape if "depth" in outputs else (0,) * 4, np.float32)
        directs = np.zeros((shape[0], 3), np.float32) if self._table is None else self._table.direct(batch.lights)
        reach = packed.reach[numbers]
        boxes_m = np.where(_CORNERS, reach[:, None, 3:], reach[:, None, :3])
        corners = np.einsum("bnji,ncj->bnci", rotations, boxes_m) + batch.positions[:, :, None]
        boxes = np.stack([screen_boxes(corners, camera)[0] for camera in cameras], axis=1)
        lenses = np.array([camera_numbers(camera) for camera in cameras]).astype(np.float32)
        step = quality.step_voxels * float(packed.scales[numbers, 3].mean()) if count else 1.0
        rules = np.array([step, quality.min_weight, quality.stop], np.float32)
        side = _COARSE_MAP if quality.one_shadow else _FINE_MAP
        mask = np.zeros((0, 0, 0), np.uint8) if only is None else np.ascontiguousarray(only).view(np.uint8)
        with ONE_AT_A_TIME:
            maps = shadow_maps(packed, numbers, rotations, batch.lights, side)
            render_batch(packed, numbers, plain_table(self._table), self._scene(batch, rotations, directs), maps,
                         directs, lenses, boxes, rules, quality.samples_per_side, mask, rgb, opacity,
                         distance)  # fmt: skip
        return Rendered(
            rgb,
            opacity if "opacity" in outputs else None,
            opacity >= MASK_OPACITY if "masks" in outputs else None,
            z_depth(distance, cameras) if "depth" in outputs else None,
        )

    def _packed(self, names: tuple[str, ...]) -> tuple[PackedTiny, np.ndarray]:
        """The fields of some objects, each packed once, and which of them each object has."""
        if names not in self._packs:
            different = list(dict.fromkeys(names))
            numbers = np.array([different.index(name) for name in names], np.int64)
            fields = [self._fields[name] for name in different] or [_nothing()]
            self._packs[names] = pack(fields), numbers
        return self._packs[names]

    def _scene(self, batch: SceneBatch, rotations: np.ndarray, directs: np.ndarray):  # noqa: ANN202 - of the kernels
        from osfcore.paper.rendering.kernels import Scene

        kept = np.full(len(batch.lights), AMBIENT, np.float32)
        if self._table is not None:
            ambient = float(self._table.ambient.mean())
            kept = (ambient / (ambient + directs.mean(axis=1))).astype(np.float32)
        pusher = np.zeros((len(batch.lights), 3)) if batch.pusher is None else batch.pusher

        def plain(array: np.ndarray) -> np.ndarray:
            """One memory layout for all batches: any other would be compiled anew."""
            return np.array(array, np.float32, order="C")

        return Scene(
            plain(rotations.reshape(*rotations.shape[:2], 9)),
            plain(batch.positions),
            plain(batch.lights),
            plain(np.einsum("bnij,bj->bni", rotations, batch.lights)),
            kept,
            plain(pusher),
            batch.pusher is not None,
        )


def _nothing() -> TinyField:
    """A field that shows nothing: scenes without objects are rendered, too."""
    cells, networks = np.full((1, 1, 1), -1, np.int32), np.zeros((1, network_size(1)), np.float32)
    return TinyField(np.zeros(3, np.float32), 1.0, np.zeros((2, 2, 2), bool), cells, networks, 1)
