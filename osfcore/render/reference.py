"""The reference renderer: compositional volume rendering of OSFs in PyTorch, every ray and every sample.

The fast renderer must compute the same as this one, and a GPU runs this one. For each ray, each object's field is
sampled in its own frame (paper eq. 1). A sample's radiance is rho L_light with one light, distant or near (eq. 2). The
samples of all objects are sorted by distance and composited (eq. 3).

Deviations from eq. 3:

- The radiance of a point is the mean of the objects' radiances weighted by their densities, as in compositional NeRFs,
  and not their sum. Overlapping objects are then not twice as bright.
- The light that reaches a point is the transmittance of all other objects along the ray toward the light. This is the
  limit of a shadow map of unlimited resolution.

`osfcore.fields.volume_rendering` explains how densities become weights and pixels.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence
from typing import NamedTuple

import numpy as np
import torch
from jaxtyping import Bool, Float
from torch import Tensor
from torch.nn.functional import grid_sample, normalize

from osfcore.fields.kiloosf import EMPTY_G, FEATURES, KiloOSF, network_size
from osfcore.fields.kiloosf_query import KiloQuery
from osfcore.fields.rays import shell_field
from osfcore.fields.table import TableField
from osfcore.fields.volume_rendering import accumulate_along_rays, final_transmittance, render_weights
from osfcore.geometry.cameras import Camera
from osfcore.geometry.light import AMBIENT, DIFFUSE, MIN_PENUMBRA_RAD, SpotLamp
from osfcore.geometry.states import SceneState
from osfcore.geometry.workspace import PUSHER_ALBEDO, PUSHER_HEIGHT_M, PUSHER_RADIUS_M
from osfcore.render.types import EXACT, Quality, Rendered, SceneBatch, camera_numbers, check_request, poses_of

# Lights: the light that points of the world receive from a distant light, and from a near lamp.
#
# Both have the same four methods. `SpotLamp` has the equations of the lamp.


FAR = 1e9


class DistantLight(NamedTuple):
    """A distant light, with the same direction at all points."""

    direction: Float[Tensor, "3"]

    def toward(self, points: Float[Tensor, "R 3"], rotation: Float[Tensor, "3 3"]) -> Float[Tensor, "R 3"]:
        """Return unit vectors from points [m] toward the light; `rotation` maps from the world to their frame."""
        return (rotation @ self.direction).expand_as(points)

    def distance(self, points: Float[Tensor, "R 3"]) -> Float[Tensor, "R"]:
        """Return distances from points to the light [m]. Objects beyond the light cast no shadow."""
        return torch.full_like(points[:, 0], FAR)

    def gain(self, points: Float[Tensor, "R 3"]) -> Float[Tensor, "R 1"]:
        """Return the share of the diffuse light that arrives at unshaded points."""
        return torch.ones_like(points[:, :1])

    def on_table(self, table: TableField, points: Float[Tensor, "R 3"]) -> Float[Tensor, "#R 3"]:
        """Return the direct light of three colours on unshaded points of a white table."""
        return torch.as_tensor(table.direct(self.direction.cpu().double().numpy()[None])).to(points)


class NearLight(NamedTuple):
    """A lamp at a finite distance."""

    position: Float[Tensor, "3"]  # [m]
    axis: Float[Tensor, "3"]  # unit vector from it toward what it looks at
    inner: float  # half-angles of its cone [rad]
    outer: float

    def toward(self, points: Float[Tensor, "R 3"], rotation: Float[Tensor, "3 3"]) -> Float[Tensor, "R 3"]:
        """Return the same as of a distant light."""
        return normalize(self.position - points, dim=-1) @ rotation.T

    def distance(self, points: Float[Tensor, "R 3"]) -> Float[Tensor, "R"]:
        """Return the same as of a distant light."""
        return torch.linalg.norm(self.position - points, dim=-1)

    def gain(self, points: Float[Tensor, "R 3"]) -> Float[Tensor, "R 1"]:
        """Return the same as of a distant light: the cone's share times the falloff, (d0 / r)^2."""
        angle = torch.arccos((normalize(points - self.position, dim=-1) @ self.axis).clamp(-1, 1))
        s = ((self.outer - angle) / max(self.outer - self.inner, MIN_PENUMBRA_RAD)).clamp(0, 1)
        falloff = (self.position @ self.position) / self.distance(points) ** 2
        return (s * s * (3 - 2 * s) * falloff)[:, None]

    def on_table(self, table: TableField, points: Float[Tensor, "R 3"]) -> Float[Tensor, "R 3"]:
        """Return the same as of a distant light."""
        directions = normalize(self.position - points, dim=-1)
        return torch.as_tensor(table.direct(directions.cpu().double().numpy())).to(points) * self.gain(points)


# Fields of known shapes, which need no training: the pusher, and other solids.


_PUSHER_VOXEL_M = 0.0025
_EDGE_G = 8.0  # g per voxel across a surface
_SOLID_G = 10.0


def pusher_field(hidden: int) -> KiloOSF:
    """Return the field of the pusher: a matte cylinder of known colour around its centre."""
    half = PUSHER_HEIGHT_M / 2

    def depth(x: Float[np.ndarray, "*s 3"]) -> Float[np.ndarray, "*s"]:
        return np.minimum(PUSHER_RADIUS_M - np.hypot(x[..., 0], x[..., 1]), half - np.abs(x[..., 2]))

    def normal(x: Float[np.ndarray, "*s 3"]) -> Float[np.ndarray, "*s 3"]:
        is_cap = half - np.abs(x[..., 2]) < PUSHER_RADIUS_M - np.hypot(x[..., 0], x[..., 1])
        wall = x * (1, 1, 0) / np.maximum(np.hypot(x[..., 0], x[..., 1]), 1e-9)[..., None]
        return np.where(is_cap[..., None], np.sign(x) * (0, 0, 1), wall)

    size = np.array([PUSHER_RADIUS_M, PUSHER_RADIUS_M, half])
    return solid_field(depth, normal, size, PUSHER_ALBEDO, voxel=_PUSHER_VOXEL_M, hidden=hidden)


def solid_field(
    depth: Callable[[np.ndarray], np.ndarray],
    normal: Callable[[np.ndarray], np.ndarray],
    half_size: Float[np.ndarray, "3"],
    albedo: tuple[float, float, float],
    *,
    voxel: float,
    hidden: int,
    g: float = _SOLID_G,
    edge_g: float = _EDGE_G,
) -> KiloOSF:
    """Make a matte solid under the world's lamp.

    Args:
        depth: function from points to their depth inside the solid [m], negative outside.
        normal: function from points near the surface to outward unit vectors.
        half_size: half the sides of its box around the origin [m].
        albedo: reflectance of the solid.
        voxel: side of the voxels [m].
        hidden: width of the (empty) networks, which must be that of the fields it is drawn with.
        g: density feature inside.
        edge_g: growth of the density feature across the surface, per voxel.
    """
    count = 2 * (np.ceil(np.asarray(half_size) / voxel).astype(int) + 2) + 1
    origin = -(count - 1) / 2 * voxel
    points = origin + voxel * np.moveaxis(np.indices(count.tolist()), 0, -1)
    features = np.zeros((*count, FEATURES), np.float32)
    features[..., 0] = np.clip(edge_g * depth(points) / voxel, EMPTY_G, g)
    features[..., 1:4] = albedo
    features[..., 4:7] = DIFFUSE * normal(points)
    keep = features[..., 0] > EMPTY_G
    networks = np.zeros((1, network_size(hidden)), np.float32)
    cells = np.zeros((1, 1, 1), np.int32)
    return shell_field(origin, voxel, features, keep, cells, networks, np.full(3, AMBIENT, np.float32))


_RAYS_AT_ONCE = 4096


class _Placed(NamedTuple):
    """An object in its pose."""

    query: KiloQuery
    extent: Float[Tensor, "2 3"]  # of what is occupied, in its own frame [m]
    rotation: Float[Tensor, "3 3"]  # from the world into its frame
    position: Float[Tensor, "3"]


class _Samples(NamedTuple):
    """The samples of one object along R rays; unused slots have no optical thickness."""

    t_mids: Float[Tensor, "R S"]  # distances of the samples [m]
    taus: Float[Tensor, "R S"]  # optical thickness
    radiance: Float[Tensor, "R S 3"]


def render_reference(
    fields: Mapping[str, KiloOSF],
    table: TableField | None,
    state: SceneState,
    camera: Camera,
    *,
    spot: SpotLamp | None = None,
    dtype: torch.dtype = torch.float64,
    quality: Quality = EXACT,
    outputs: frozenset[str] | set[str] = frozenset({"rgb"}),
) -> Rendered:
    """Render one scene from one camera.

    Args:
        fields: fields of the objects, by name.
        table: field of the table; None for a black background.
        state: the scene.
        camera: the camera.
        spot: a near lamp in place of the state's light.
        dtype: data type of the computation.
        quality: accuracy, of which only the sample spacing and the rays per pixel are used. Nothing is skipped here.
        outputs: as in `SceneRenderer.render`.

    Raises:
        UnknownName: if an object has no field.
        InvalidInput: if an output is unknown.
    """
    batch = SceneBatch.of(state, spot)
    check_request(fields, batch, (camera,), outputs)
    return _render_batch(fields, table, batch, (camera,), torch.device("cpu"), dtype, quality, outputs)


def render_on_device(
    fields: Mapping[str, KiloOSF], table: TableField | None, batch: SceneBatch, cameras: Sequence[Camera], device: str,
    quality: Quality, outputs: frozenset[str] | set[str], only: Bool[np.ndarray, "V h w"] | None = None,
) -> Rendered:  # fmt: skip
    """Render a batch in single precision on a PyTorch device.

    Args:
        fields: fields of the objects, by name.
        table: field of the table; None for a black background.
        batch: B scenes.
        cameras: V cameras of one image size.
        device: PyTorch device.
        quality: accuracy, of which only the sample spacing and the rays per pixel are used. Nothing is skipped here.
        outputs: as in `SceneRenderer.render`.
        only: pixels to keep; all others come out black and empty.
    """
    rendered = _render_batch(fields, table, batch, cameras, torch.device(device), torch.float32, quality, outputs)
    if only is None:
        return rendered
    return Rendered(
        rendered.rgb * only[None, ..., None],
        None if rendered.opacity is None else rendered.opacity * only[None, :, None],
        None if rendered.masks is None else rendered.masks & only[None, :, None],
        None if rendered.depth is None else rendered.depth * only[None],
    )


@torch.no_grad()
def _render_batch(fields, table, batch, cameras, device, dtype, quality, outputs) -> Rendered:  # noqa: ANN001
    names, solids = [*batch.names], {name: fields[name] for name in batch.names}
    if batch.pusher is not None:
        names.append(None)  # not "pusher": an object may have any name
        solids[None] = pusher_field(next(iter(fields.values())).hidden if fields else 1)
    queries = {name: KiloQuery(field, dtype=dtype, device=device) for name, field in solids.items()}
    size, count = (cameras[0].height, cameras[0].width), len(batch.names)
    rgb = np.zeros((len(batch.lights), len(cameras), *size, 3), np.float32)
    opacity = np.zeros((len(batch.lights), len(cameras), count, *size), np.float32)
    depth = np.zeros(rgb.shape[:-1], np.float32)

    def tensor(array: object) -> Tensor:
        return torch.as_tensor(np.array(array), dtype=dtype, device=device)

    for b, (rotations, positions) in enumerate(zip(*poses_of(batch), strict=True)):
        if batch.spots is None:
            light = DistantLight(tensor(batch.lights[b]))
        else:
            spot = batch.spots[b]
            light = NearLight(tensor(spot.position), tensor(spot.axis), *spot.cone_rad)
        placed = [_Placed(queries[name], tensor(_extent(solids[name])), tensor(R), tensor(p))
                  for name, R, p in zip(names, rotations, positions, strict=True)]  # fmt: skip
        for v, camera in enumerate(cameras):
            colours, shares, depths = _render_image(placed, table, light, camera, quality, tensor)
            rgb[b, v], depth[b, v] = colours.cpu().numpy(), depths.cpu().numpy()
            opacity[b, v] = shares[:count].cpu().numpy()
    return Rendered.of(rgb, opacity, depth, outputs)


def _extent(field: KiloOSF) -> np.ndarray:
    """Return the occupied part of a field, one voxel wider: density is interpolated."""
    low, high = field.extent
    box = field.box
    return np.stack([np.maximum(low - field.voxel, box[0]), np.minimum(high + field.voxel, box[1])])


def _render_image(placed, table, light, camera, quality, tensor):  # noqa: ANN001, ANN202
    """Return colours (h, w, 3), shares of the objects (N, h, w) and z-depths (h, w) of one image."""
    s = quality.samples_per_side
    height, width = camera.height, camera.width
    numbers = tensor(camera_numbers(camera))
    axis = tensor(camera.T_world_camera.matrix()[:3, 2])
    rows = torch.arange(height * s, device=numbers.device, dtype=numbers.dtype) + 0.5
    columns = torch.arange(width * s, device=numbers.device, dtype=numbers.dtype) + 0.5
    v, u = torch.meshgrid(rows / s, columns / s, indexing="ij")
    places = torch.stack([u, v, torch.ones_like(u)], dim=-1).reshape(-1, 3)
    rays_d = normalize(places @ numbers[3:].view(3, 3).T, dim=-1)
    parts = [_render_rays(placed, table, light, numbers[:3], d, quality, tensor) for d in rays_d.split(_RAYS_AT_ONCE)]
    colour, shares, distance, weight = (torch.cat(part) for part in zip(*parts, strict=True))

    def pixels(values: Tensor) -> Tensor:
        """Return means over the rays of each pixel."""
        return values.view(height, s, width, s, -1).mean(dim=(1, 3))

    whole = pixels(weight[:, None])[..., 0]
    z = distance * (rays_d @ axis)
    depth = torch.where(whole > 1e-3, pixels(z[:, None])[..., 0] / whole.clamp(min=1e-9), 0)
    return pixels(colour), pixels(shares).permute(2, 0, 1), depth


def _render_rays(placed, table, light, rays_o, rays_d, quality, tensor):  # noqa: ANN001, ANN202
    """Return radiance (R, 3), objects' weights (R, N), weighted distance (R) and weight (R) of rays from one point."""
    count = len(rays_d)
    table_t = _intersect_table(table, rays_o, rays_d)
    samples = [_sample_object(placed, n, light, rays_o, rays_d, table_t, quality) for n in range(len(placed))]
    owner = torch.cat([torch.full((s.t_mids.shape[1],), n) for n, s in enumerate(samples)] or [torch.zeros(0)])
    if samples:
        t_mids, order = torch.cat([s.t_mids for s in samples], dim=1).sort(dim=1)
        taus = torch.cat([s.taus for s in samples], dim=1).gather(1, order)
        radiance = torch.cat([s.radiance for s in samples], dim=1).gather(1, order[..., None].expand(-1, -1, 3))
    else:
        t_mids, taus, order = (rays_d.new_zeros(count, 0) for _ in range(3))
        radiance = rays_d.new_zeros(count, 0, 3)
    weights, remaining = render_weights(taus), final_transmittance(taus)
    colour = accumulate_along_rays(weights, radiance)
    owners = owner.to(rays_d.device)[order.long()] if samples else order
    shares = torch.stack([(weights * (owners == n)).sum(dim=1) for n in range(len(placed))] or [remaining[:0]], dim=-1)
    shares = shares if placed else rays_d.new_zeros(count, 0)
    hit = table_t < FAR
    distance = (weights * t_mids.clamp(max=FAR)).sum(dim=1) + torch.where(hit, remaining * table_t, 0)
    weight = weights.sum(dim=1) + remaining * hit
    if table is not None:
        behind = tensor(table.background).expand(count, 3).clone()
        points = rays_o + table_t[hit, None] * rays_d[hit]
        visible = _light_transmittance(placed, -1, points, light, quality)
        direct = light.on_table(table, points)
        behind[hit] = _albedo(table, points, tensor) * (tensor(table.ambient) + visible[:, None] * direct)
        colour = colour + remaining[:, None] * behind
    return colour, shares, distance, weight


def _intersect_table(table: TableField | None, rays_o: Tensor, rays_d: Float[Tensor, "R 3"]) -> Float[Tensor, "R"]:
    """Return the distance to the table [m]; very far for rays that miss it."""
    far = torch.full_like(rays_d[:, 0], FAR)
    if table is None or rays_o[2] <= 0:
        return far
    down = rays_d[:, 2] < -1e-9
    t = torch.where(down, -rays_o[2] / torch.where(down, rays_d[:, 2], -1), far)
    places = rays_o[:2] + t[:, None] * rays_d[:, :2]
    return torch.where(down & (places.abs() <= table.half_side).all(dim=-1), t, far)


def _march(
    placed: _Placed, rays_o: Float[Tensor, "R 3"], rays_d: Float[Tensor, "R 3"], far: Float[Tensor, "R"], step: float
) -> Iterator[tuple[Float[Tensor, "R"], Float[Tensor, "R"]]]:
    """March rays through an object's extent: yield distances of the next samples, and which rays have one there."""
    safe = torch.where(rays_d.abs() < 1e-9, 1e-9, rays_d)
    a, b = (placed.extent[0] - rays_o) / safe, (placed.extent[1] - rays_o) / safe
    near = torch.minimum(a, b).amax(dim=-1).clamp(min=0)
    end = torch.minimum(torch.maximum(a, b).amin(dim=-1), far)
    k = torch.ceil(near / step - 0.5)
    longest = ((end - near).clamp(min=0).max() / step) if len(end) else torch.tensor(0.0)
    for _ in range(int(longest) + 2):
        t = (k + 0.5) * step
        yield t, t <= end
        k = k + 1


def _to_object_frame(placed: _Placed, points: Float[Tensor, "R 3"]) -> Float[Tensor, "R 3"]:
    return (points - placed.position) @ placed.rotation.T


def _sample_object(placed, n, light, rays_o, rays_d, table_t, quality) -> _Samples:  # noqa: ANN001
    """Sample object n along each ray: tau_i = sigma_i delta, radiance from the OSF (paper eqs. 1 and 2)."""
    own = placed[n]
    step = quality.step_voxels * own.query.voxel
    local_o = _to_object_frame(own, rays_o[None]).expand_as(rays_d)
    local_d = rays_d @ own.rotation.T
    t_mids, taus, radiances = [], [], []
    for t, used in _march(own, local_o, local_d, table_t, step):
        tau, radiance = torch.zeros_like(t), torch.zeros_like(rays_d)
        x = (local_o + t[:, None] * local_d)[used]
        if len(x):
            sigma = own.query.density(x)
            some = sigma > 0
            inside = used.nonzero()[:, 0][some]
            tau[inside] = sigma[some] * step
            points = rays_o + t[inside, None] * rays_d[inside]
            scatter = own.query(x[some], light.toward(points, own.rotation), local_d[inside])
            visible = _light_transmittance(placed, n, points, light, quality)
            radiance[inside] = scatter.ambient + visible[:, None] * light.gain(points) * scatter.direct
        t_mids.append(torch.where(used, t, FAR))
        taus.append(tau)
        radiances.append(radiance)
    if not t_mids:
        nothing = rays_d.new_zeros(len(rays_d), 0)
        return _Samples(nothing, nothing, rays_d.new_zeros(len(rays_d), 0, 3))
    return _Samples(torch.stack(t_mids, 1), torch.stack(taus, 1), torch.stack(radiances, 1))


def _light_transmittance(placed, skip, points, light, quality) -> Float[Tensor, "R"]:  # noqa: ANN001
    """Return the transmittance from points in the world toward the light through all objects but one: their shadow."""
    total = points.new_zeros(len(points))
    for n, other in enumerate(placed):
        if n == skip or not len(points):
            continue
        rays_o = _to_object_frame(other, points)
        direction = light.toward(points, other.rotation)
        step = quality.shadow_voxels * other.query.voxel
        for t, used in _march(other, rays_o, direction, light.distance(points), step):
            if used.any():
                x = (rays_o + t[:, None] * direction)[used]
                total[used] += other.query.density(x) * step
    return torch.exp(-total)


def _albedo(table: TableField, points: Float[Tensor, "R 3"], tensor) -> Float[Tensor, "R 3"]:  # noqa: ANN001
    grid = tensor(table.albedo).permute(2, 1, 0)[None]  # rows of an image run along y
    places = points[None, None, :, :2] / table.half_side
    return grid_sample(grid, places, align_corners=True)[0, :, 0].T
