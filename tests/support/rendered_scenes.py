"""Fields and scenes made by formula: what tests render and learn needs no training and no mesh."""

from dataclasses import replace

import numpy as np

from osfcore.fields.kiloosf import DENSITY_FLOOR, EMPTY_G, KiloOSF, network_size
from osfcore.fields.table import TableField
from osfcore.geometry.cameras import Camera
from osfcore.geometry.light import Light
from osfcore.geometry.poses import Pose, quaternion_exp
from osfcore.geometry.states import SceneState
from osfcore.geometry.workspace import PUSHER_CENTRE_Z_M
from osfcore.render.reference import render_reference, solid_field
from osfcore.render.renderer import SceneRenderer
from osfcore.render.types import EXACT, OUTPUTS, Rendered, SceneBatch

HIDDEN = 8
UPRIGHT = (1.0, 0.0, 0.0, 0.0)


def ball(radius: float = 0.05, *, voxel: float = 0.005, albedo=(0.8, 0.5, 0.3), **density) -> KiloOSF:
    def depth(x):
        return radius - np.linalg.norm(x, axis=-1)

    def normal(x):
        return x / np.maximum(np.linalg.norm(x, axis=-1, keepdims=True), 1e-9)

    return solid_field(depth, normal, np.full(3, radius), albedo, voxel=voxel, hidden=HIDDEN, **density)


def block(half=(0.04, 0.03, 0.05), *, voxel: float = 0.005, albedo=(0.3, 0.6, 0.8), **density) -> KiloOSF:
    half = np.asarray(half)

    def depth(x):
        return (half - np.abs(x)).min(axis=-1)

    def normal(x):
        axis = np.argmin(half - np.abs(x), axis=-1)
        return np.sign(x) * (axis[..., None] == np.arange(3))

    return solid_field(depth, normal, half, albedo, voxel=voxel, hidden=HIDDEN, **density)


def fog(half=(0.04, 0.04, 0.04), g: float = -2.0, voxel: float = 0.005) -> KiloOSF:
    """A block of one density, its outermost corners included; beyond them g falls to that of empty space."""
    return block(np.asarray(half) + 0.01 * voxel, voxel=voxel, g=g, edge_g=1e4)


def fog_depth(field: KiloOSF, g: float, thickness: float) -> float:
    """Optical depth across a fog: the uniform part, and the rims of one voxel in which g falls linearly."""

    def per_voxel(g):
        return np.maximum(np.logaddexp(g, 0) - DENSITY_FLOOR, 0)

    rim = np.mean(per_voxel(g + (EMPTY_G - g) * (np.arange(10_000) + 0.5) / 10_000))
    return float(per_voxel(g) * thickness / field.voxel + 2 * rim)


def corners_of(field: KiloOSF) -> np.ndarray:
    """Positions of the corners in the shell, in the order of `rows[1:]`."""
    places = np.zeros((len(field.rows), 3))
    inside = np.argwhere(field.index > 0)
    places[field.index[field.index > 0]] = field.origin + field.voxel * inside
    return places[1:]


def coloured(field: KiloOSF, colours) -> KiloOSF:
    """The field with the albedos that `colours` makes of corner positions (n, 3)."""
    rows = field.rows.copy()
    rows[1:, 1:4] = colours(corners_of(field))
    return replace(field, rows=rows)


def random_field(rng: np.random.Generator, *, hidden: int = HIDDEN) -> KiloOSF:
    """A ball or block, hard or foggy, of random colours, with cells of random networks."""
    size = rng.uniform(0.02, 0.06, 3)
    density = {"g": float(rng.choice([-1.0, 2.0, 10.0])), "edge_g": float(rng.choice([2.0, 8.0]))}
    voxel = float(size.max() / 8)
    plain = ball(size[0], voxel=voxel, **density) if rng.random() < 0.5 else block(size, voxel=voxel, **density)
    rows = plain.rows.copy()
    rows[1:, 1:4] = rng.uniform(0, 1, (len(rows) - 1, 3))
    rows[1:, 4:] += 0.2 * rng.normal(size=(len(rows) - 1, 4))
    cells = rng.permutation(12).reshape(3, 2, 2).astype(np.int32)
    networks = (0.15 * rng.normal(size=(12, network_size(hidden)))).astype(np.float32)
    ambient = rng.uniform(0.1, 0.4, 3).astype(np.float32)
    rows = rows.astype(np.float32)
    return KiloOSF(plain.origin, plain.voxel, plain.index, rows, cells, networks, hidden, ambient)


def wooden_table(half_side: float = 0.6, seed: int = 0) -> TableField:
    """A table of random albedo whose direct light is 0.75 l_z per unit of albedo."""
    rng = np.random.default_rng(seed)
    albedo = rng.uniform(0.3, 0.7, (8, 8, 3)).astype(np.float32)
    return table_of(albedo, half_side)


def plain_table(albedo: float = 0.5, half_side: float = 0.6) -> TableField:
    return table_of(np.full((2, 2, 3), albedo, np.float32), half_side)


def table_of(albedo: np.ndarray, half_side: float) -> TableField:
    quarter = np.full(3, 0.25, np.float32)
    nothing = np.zeros((3, 4), np.float32), np.zeros(4, np.float32), np.zeros((4, 3), np.float32)
    return TableField(half_side, albedo, quarter, np.float32([0.1, 0.2, 0.3]), *nothing, np.full(3, 0.75, np.float32))


def state(poses: dict[str, tuple], light=(0.3, 0.2, 0.9), pusher=None) -> SceneState:
    """A scene of objects given as name: position or (position, quaternion)."""
    pairs = [p if len(p) == 2 else (p, UPRIGHT) for p in poses.values()]
    position = np.array([p for p, _ in pairs], float).reshape(-1, 3)
    quaternion = np.array([q for _, q in pairs], float).reshape(-1, 4)
    pusher = None if pusher is None else np.asarray(pusher, float)
    return SceneState(tuple(poses), Pose(position, quaternion), Light(np.asarray(light, float)), pusher)


def random_scene(seed: int, count: int | None = None) -> tuple[dict[str, KiloOSF], SceneState]:
    """1 to 4 random fields at random poses above the table, near each other so that they shade one another."""
    rng = np.random.default_rng(seed)
    count = count or int(rng.integers(1, 5))
    fields = {f"object{i}": random_field(rng) for i in range(count)}
    position = np.concatenate([rng.uniform(-0.12, 0.12, (count, 2)), rng.uniform(0.03, 0.1, (count, 1))], axis=1)
    quaternion = quaternion_exp(rng.normal(size=(count, 3)))
    pusher = np.array([*rng.uniform(-0.1, 0.1, 2), PUSHER_CENTRE_Z_M]) if rng.random() < 0.5 else None
    light = Light.random(rng, min_elevation_deg=10.0)
    return fields, SceneState(tuple(fields), Pose(position, quaternion), light, pusher)


def view(position=(0.5, 0.1, 0.4), target=(0.0, 0.0, 0.03), size: int = 32, fov_y_deg: float = 40.0) -> Camera:
    return Camera.look_at("view", position, target, size=size, fov_y_deg=fov_y_deg)


def camera_rays(camera: Camera) -> tuple[np.ndarray, np.ndarray]:
    """Origins and directions through all pixel centres, row by row, in single precision."""
    row, column = np.divmod(np.arange(camera.width * camera.height), camera.width)
    directions = camera.ray_directions(np.stack([column + 0.5, row + 0.5], axis=1)).astype(np.float32)
    return np.broadcast_to(camera.T_world_camera.position.astype(np.float32), directions.shape), directions


def both(fields, table, scene: SceneState, camera: Camera, quality=EXACT, spot=None) -> tuple[Rendered, Rendered]:
    """Everything from one camera, from the reference and from the fast path."""
    slow = render_reference(fields, table, scene, camera, spot=spot, quality=quality, outputs=OUTPUTS)
    fast = SceneRenderer(fields, table).render(SceneBatch.of(scene, spot), [camera], quality=quality, outputs=OUTPUTS)
    return slow, fast
