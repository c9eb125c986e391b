"""Pictures of the simulated table by ray tracing: meshes, table, pusher, lamps, shadows and lenses."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from concurrent.futures import Executor
from dataclasses import KW_ONLY, dataclass, field
from importlib.util import find_spec
from itertools import pairwise
from typing import TYPE_CHECKING

import cv2
import numpy as np
from jaxtyping import Bool, Float, Int

from osfcore.errors import InvalidInput
from osfcore.geometry.cameras import Camera
from osfcore.geometry.light import AMBIENT, DIFFUSE, SpotLamp
from osfcore.geometry.poses import Pose, quaternion_to_matrix
from osfcore.geometry.states import SceneState
from osfcore.geometry.workspace import PUSHER_ALBEDO, PUSHER_HEIGHT_M, PUSHER_RADIUS_M, TABLE_SIDE_M
from osfcore.objects.asset import TexturedMesh

if TYPE_CHECKING or find_spec("embreex") is not None:
    from osfcore.world.embree import Triangles
else:  # as on Linux on ARM, for which there are no wheels of it
    from osfcore.world.bounding_boxes import Triangles

# Materials and lamp of the image model: Lambert shading without specular part,
#
#     radiance = albedo * (ambient + diffuse * max(0, n . l) * visible),    visible in {0, 1},
#
# in linear values, no gamma. A near lamp has a place, a cone and falloff besides (`SpotLamp`). Lamps of another
# strength or colour, shiny objects and other tables serve to measure methods that do not know of them.

TABLE_ALBEDO = (0.66, 0.62, 0.56)  # pale wood, uniform, so that only light and shadow change it
BACKGROUND_RADIANCE = (0.10, 0.11, 0.12)  # beyond the table's edge; no lamp reaches it
WHITE = (1.0, 1.0, 1.0)
_REMAP_COLUMNS = 512  # OpenCV's remap takes at most 32767 rows and columns


@dataclass(frozen=True, slots=True)
class Lamp:
    """How strongly the scene is lit.

    Attributes:
        ambient: radiance of a white surface in shadow.
        diffuse: what the light adds when it falls in along the normal.
        intensity: factor on both.
        colour: factors on both, of red, green and blue.
        specular: what the light adds on an object, whatever its albedo, where it is mirrored toward the eye.
    """

    ambient: float = AMBIENT
    diffuse: float = DIFFUSE
    intensity: float = 1.0
    colour: tuple[float, float, float] = WHITE
    specular: float = 0.0


@dataclass(frozen=True, eq=False, slots=True)
class TableSurface:
    """The look of the table's top.

    Attributes:
        albedo: albedo of every point, linear; not used where there is a texture.
        texture: linear albedo in [0, 1], spread once over the table: its first row lies at the side of greatest y, its
            first column at that of least x. None for a table of one colour.
        levels: mip pyramid of the texture; empty if there is none.
    """

    albedo: tuple[float, float, float] = TABLE_ALBEDO
    texture: Float[np.ndarray, "rows columns 3"] | None = None
    levels: tuple[Float[np.ndarray, "_ _ 3"], ...] = field(init=False, repr=False)

    def __post_init__(self) -> None:
        """Check the texture and build its pyramid.

        Raises:
            InvalidInput: if the texture is not linear RGB in [0, 1].
        """
        levels = ()
        if self.texture is not None:
            texture = np.asarray(self.texture, np.float32)
            if texture.ndim != 3 or texture.shape[2] != 3 or not np.all((texture >= 0) & (texture <= 1)):
                raise InvalidInput("texture of the table", f"of shape {texture.shape}", "rows of RGB in [0, 1]")
            levels = _mip_pyramid(texture)
        object.__setattr__(self, "levels", levels)

    def albedo_at(self, points: Float[np.ndarray, "S 2"], footprint_m: float = 0.0) -> Float[np.ndarray, "S 3"]:
        """Interpolate the albedo at points of the table.

        Args:
            points: x and y in the world [m].
            footprint_m: side of the square over which a texture is averaged [m]; 0 takes its finest level.
        """
        if self.texture is None:
            return np.broadcast_to(np.array(self.albedo, np.float32), (len(points), 3))
        across, down = points[:, 0] / TABLE_SIDE_M + 0.5, 0.5 - points[:, 1] / TABLE_SIDE_M
        return _trilinear(self.levels, across, down, footprint_m * max(self.texture.shape[:2]) / TABLE_SIDE_M)


def _mip_pyramid(texture: np.ndarray) -> tuple[np.ndarray, ...]:
    """Halve a texture down to 1 texel, each level the area average of the one before; the finest comes first."""
    levels = [np.ascontiguousarray(texture)]
    while max(levels[-1].shape[:2]) > 1:
        height, width = levels[-1].shape[:2]
        half = (max(width // 2, 1), max(height // 2, 1))
        levels.append(cv2.resize(levels[-1], half, interpolation=cv2.INTER_AREA))
    return tuple(levels)


def _trilinear(
    levels: tuple[np.ndarray, ...], across: Float[np.ndarray, "S"], down: Float[np.ndarray, "S"], texels: float
) -> Float[np.ndarray, "S 3"]:
    """Look up colours in [0, 1], interpolated between texels and between levels.

    Args:
        levels: levels of a mip pyramid, of float32 or of 8 bits.
        across: places from the left (0) to the right side (1) of the texture.
        down: places from the top (0) to the bottom (1).
        texels: side of the square that is averaged, in texels of the finest level.
    """
    level = min(float(np.log2(max(texels, 1.0))), len(levels) - 1.0)
    fine = int(level)
    colours = _bilinear(levels[fine], across, down)
    if level > fine:
        colours += (level - fine) * (_bilinear(levels[fine + 1], across, down) - colours)
    return colours


def _bilinear(texture: np.ndarray, across: Float[np.ndarray, "S"], down: Float[np.ndarray, "S"]) -> np.ndarray:
    """Interpolate a texture between its texels, clamped at its border."""
    height, width = texture.shape[:2]
    count = len(across)
    shape = (max(-(-count // _REMAP_COLUMNS), 1), _REMAP_COLUMNS)
    x, y = np.zeros((2, shape[0] * shape[1]), np.float32)
    x[:count] = across * width - 0.5
    y[:count] = down * height - 0.5
    flat = cv2.remap(texture, x.reshape(shape), y.reshape(shape), cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE)
    colours = flat.reshape(-1, 3)[:count]
    return colours.astype(np.float32) / 255 if texture.dtype == np.uint8 else colours


def lambert(
    albedo: Float[np.ndarray, "S 3"], cosine: Float[np.ndarray, "S"], visible: Float[np.ndarray, "S"], lamp: Lamp
) -> Float[np.ndarray, "S 3"]:
    """Compute the radiance of matte surfaces.

    Args:
        albedo: linear, in [0, 1].
        cosine: n . l, times a near lamp's falloff and cone.
        visible: 1 where the light arrives, 0 in shadow.
        lamp: strengths of ambient and diffuse light, and their colour.
    """
    irradiance = lamp.intensity * (lamp.ambient + lamp.diffuse * np.maximum(cosine, 0) * visible)
    radiance = albedo * irradiance[:, None]
    return radiance if lamp.colour == WHITE else radiance * np.array(lamp.colour, radiance.dtype)


_SHININESS = 32.0  # exponent of highlights


def highlight(
    normals: Float[np.ndarray, "S 3"],
    directions: Float[np.ndarray, "S 3"],
    light: Float[np.ndarray, "3"],
    visible: Float[np.ndarray, "S"],
    lamp: Lamp,
) -> Float[np.ndarray, "S 1"]:
    """Compute what a distant light adds on shiny surfaces: specular * max(0, n . h)^32 (Blinn, 1977).

    Args:
        normals: unit, toward the eye.
        directions: directions of rays from the eye, of any length.
        light: unit vector toward the light.
        visible: 1 where the light arrives, 0 in shadow.
        lamp: its strength.
    """
    halfway = light - directions / np.linalg.norm(directions, axis=1, keepdims=True)
    cosine = np.einsum("ij,ij->i", normals, halfway) / np.maximum(np.linalg.norm(halfway, axis=1), 1e-9)
    return (lamp.intensity * lamp.specular * visible * np.maximum(cosine, 0) ** _SHININESS)[:, None]


# Rays and one textured mesh: intersection and occlusion, prefiltered texture lookup.
#
# The ray structure is built once per object, in the object's own frame; scenes move rays, not meshes.


class TracedMesh(Triangles):
    """A textured mesh that answers ray queries in its own frame.

    Args:
        mesh: what to trace.
    """

    def __init__(self, mesh: TexturedMesh) -> None:
        vertices = np.ascontiguousarray(mesh.vertices, np.float32)
        faces = np.ascontiguousarray(mesh.faces, np.int32)
        super().__init__(vertices, faces)
        corners = vertices[faces]
        self._face_normals = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
        self._corner_normals = mesh.normals[faces].astype(np.float32)
        self._corner_uv = mesh.uv[faces].astype(np.float32)
        self._pyramid = _mip_pyramid(mesh.texture)
        self._texels_per_m = _texels_per_metre(mesh)
        self.bounds = np.stack([vertices.min(0), vertices.max(0)])
        self.radius_m = float(np.linalg.norm(vertices, axis=1).max())

    def surface(
        self, faces: Int[np.ndarray, "S"], barycentric: Float[np.ndarray, "S 2"], directions: Float[np.ndarray, "S 3"]
    ) -> tuple[Float[np.ndarray, "S 3"], Float[np.ndarray, "S 2"]]:
        """Interpolate normals and texture coordinates where rays hit.

        Args:
            faces: that were hit.
            barycentric: weights of each face's second and third corner.
            directions: directions of the rays in the object's frame.

        Returns:
            Smooth unit normals in the object's frame, toward the side that was hit; texture coordinates, v upwards.
        """
        u, v = barycentric[:, :1], barycentric[:, 1:]
        weights = np.concatenate([1 - u - v, u, v], axis=1)[:, :, None]
        normals = (self._corner_normals[faces] * weights).sum(axis=1)
        normals /= np.maximum(np.linalg.norm(normals, axis=1, keepdims=True), 1e-9)
        # Which side was hit is decided by the flat face: smooth normals tilt away from the eye at silhouettes.
        behind = np.einsum("ij,ij->i", self._face_normals[faces], directions) > 0
        normals[behind] *= -1
        return normals, (self._corner_uv[faces] * weights).sum(axis=1)

    def albedo(self, uv: Float[np.ndarray, "S 2"], footprint_m: float) -> Float[np.ndarray, "S 3"]:
        """Average texture colours over about `footprint_m` [m] on the surface; 0 takes the finest level."""
        return _trilinear(self._pyramid, uv[:, 0], 1 - uv[:, 1], footprint_m * self._texels_per_m)

    def screen_box(self, pose: Pose, camera: Camera) -> tuple[int, int, int, int] | None:
        """Return the pixel rectangle (left, top, right, bottom; right and bottom excluded) that holds the mesh.

        None where it is out of view. The whole image where the mesh reaches behind the camera.

        Args:
            pose: `T_world_object`.
            camera: the view.
        """
        width, height = camera.width, camera.height
        corners = np.stack(np.meshgrid(*self.bounds.T, indexing="ij"), axis=-1).reshape(-1, 3)
        points = (camera.T_world_camera.inverse() @ pose).apply(corners)
        if points[:, 2].max() <= 0:
            return None
        if points[:, 2].min() <= 1e-3:
            return 0, 0, width, height
        pixels = points @ camera.intrinsics.T
        pixels = pixels[:, :2] / pixels[:, 2:]
        left, top = np.clip(np.floor(pixels.min(0)).astype(int), 0, (width, height))
        right, bottom = np.clip(np.ceil(pixels.max(0)).astype(int), 0, (width, height))
        return (int(left), int(top), int(right), int(bottom)) if right > left and bottom > top else None


def into_frame(
    pose: Pose, origins: Float[np.ndarray, "S 3"], directions: Float[np.ndarray, "S 3"]
) -> tuple[Float[np.ndarray, "S 3"], Float[np.ndarray, "S 3"]]:
    """Move world rays into the frame of an object, contiguous float32 for Embree.

    Args:
        pose: `T_world_object`.
        origins: in the world [m].
        directions: in the world, of any length, which they keep.
    """
    rotation = quaternion_to_matrix(pose.quaternion).astype(np.float32)
    position = pose.position.astype(np.float32)
    return np.ascontiguousarray((origins - position) @ rotation), np.ascontiguousarray(directions @ rotation)


def _texels_per_metre(mesh: TexturedMesh) -> float:
    """Compute the mean texture density: square root of texture area [texel^2] over surface area [m^2]."""
    corners = mesh.vertices[mesh.faces].astype(float)
    area = np.linalg.norm(np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]), axis=1).sum()
    height, width = mesh.texture.shape[:2]
    uv = mesh.uv[mesh.faces].astype(float) * (width, height)
    a, b = uv[:, 1] - uv[:, 0], uv[:, 2] - uv[:, 0]
    return float(np.sqrt(max(np.abs(a[:, 0] * b[:, 1] - a[:, 1] * b[:, 0]).sum(), 1e-12) / max(area, 1e-12)))


# The pusher: a known cylinder, drawn, shading and colliding like everything else.


_SIDES = 96


def pusher_mesh() -> TexturedMesh:
    """Build the cylinder around its centre, with a round wall, flat caps and one colour."""
    angles = np.linspace(0, 2 * np.pi, _SIDES, endpoint=False)
    circle = np.stack([np.cos(angles), np.sin(angles)], axis=1)
    half = PUSHER_HEIGHT_M / 2
    rings = [np.column_stack([PUSHER_RADIUS_M * circle, np.full(_SIDES, z)]) for z in (-half, half)]
    wall = np.column_stack([circle, np.zeros(_SIDES)])
    down, up = np.tile([0.0, 0, -1], (_SIDES, 1)), np.tile([0.0, 0, 1], (_SIDES, 1))
    vertices = np.concatenate([*rings, *rings]).astype(np.float32)
    normals = np.concatenate([wall, wall, down, up]).astype(np.float32)
    i, k = np.arange(_SIDES), np.arange(1, _SIDES - 1)
    j = (i + 1) % _SIDES
    bottom, top = np.full_like(k, 2 * _SIDES), np.full_like(k, 3 * _SIDES)
    corners = (
        *((i, j, j + _SIDES), (i, j + _SIDES, i + _SIDES)),  # of the wall
        *((bottom, bottom + k + 1, bottom + k), (top, top + k, top + k + 1)),
    )
    faces = np.concatenate([np.stack(each, axis=1) for each in corners]).astype(np.int32)
    texture = np.round(np.array(PUSHER_ALBEDO) * 255).astype(np.uint8).reshape(1, 1, 3)
    return TexturedMesh(vertices, normals, faces, np.full((len(vertices), 2), 0.5, np.float32), texture)


# One view to trace: its bodies, camera and light; its rays and shadows.


_CHUNK = 1 << 17  # samples traced at once, to bound memory at large image sizes


@dataclass(frozen=True, eq=False, slots=True)
class Body:
    """A mesh at its place in one scene.

    Attributes:
        mesh: the shape.
        pose: `T_world_object`.
    """

    mesh: TracedMesh
    pose: Pose


@dataclass(frozen=True, eq=False, slots=True)
class PixelSamples:
    """A grid of samples in each of some pixels.

    Attributes:
        rows: rows of the pixels.
        columns: columns of the pixels.
        points: pixel coordinates of the samples [px], those of one pixel after those of another.
    """

    rows: Int[np.ndarray, "P"]
    columns: Int[np.ndarray, "P"]
    points: Float[np.ndarray, "S 2"]

    def means(self, values: Float[np.ndarray, "S C"]) -> Float[np.ndarray, "P C"]:
        """Average over each pixel's samples, as a matrix product: numpy reduces short axes slowly."""
        channels, pixels = values.shape[1], len(self.rows)
        per_pixel = len(values) // pixels
        average = np.tile(np.eye(channels, dtype=np.float32), (per_pixel, 1)) / np.float32(per_pixel)
        return values.reshape(pixels, per_pixel * channels) @ average


@dataclass(frozen=True, eq=False, slots=True)
class Shot:
    """One view to trace.

    Attributes:
        bodies: bodies of the scene.
        light: unit vector toward the light, float32.
        camera: the view.
        lamp: how strongly, and in which colour, the scene is lit.
        table: the look of the table; None where there is none.
        samples: along each side of a pixel.
        sharp: take textures at their finest level and sample every pixel alike.
        spot: a near lamp in the place of the distant light.
    """

    bodies: tuple[Body, ...]
    light: Float[np.ndarray, "3"]
    camera: Camera
    lamp: Lamp
    table: TableSurface | None
    samples: int
    sharp: bool
    spot: SpotLamp | None = None

    @property
    def origin(self) -> Float[np.ndarray, "3"]:
        """Centre of projection [m], float32."""
        return self.camera.T_world_camera.position.astype(np.float32)

    @property
    def pixels_to_world(self) -> Float[np.ndarray, "3 3"]:
        """Matrix from homogeneous pixel coordinates to directions in the world."""
        inverse = np.linalg.inv(self.camera.intrinsics)
        return quaternion_to_matrix(self.camera.T_world_camera.quaternion) @ inverse

    def directions(self, points: Float[np.ndarray, "S 2"]) -> Float[np.ndarray, "S 3"]:
        """Return world directions through pixel coordinates, scaled so that the ray parameter is the depth along z."""
        homogeneous = np.concatenate([points, np.ones((len(points), 1), np.float32)], axis=1)
        return homogeneous @ self.pixels_to_world.T.astype(np.float32)

    def sampled(self, pixels: Bool[np.ndarray, "h w"]) -> Iterator[PixelSamples]:
        """Yield grids of samples in the chosen pixels, some pixels at a time."""
        rows, columns = np.nonzero(pixels)
        side = self.samples
        offsets = (np.arange(side) + 0.5) / side
        grid = np.stack(np.meshgrid(offsets, offsets), axis=-1).reshape(-1, 2)
        per_chunk = max(_CHUNK // side**2, 1)
        for start in range(0, len(rows), per_chunk):
            r, c = rows[start : start + per_chunk], columns[start : start + per_chunk]
            points = (np.stack([c, r], axis=-1)[:, None] + grid).reshape(-1, 2).astype(np.float32)
            yield PixelSamples(r, c, points)

    def incidence(
        self, points: Float[np.ndarray, "S 3"], normals: Float[np.ndarray, "S 3"] | Float[np.ndarray, "3"]
    ) -> Float[np.ndarray, "S"]:
        """Return the cosine of the light's angle to the normals at points, times a near lamp's falloff and cone."""
        if self.spot is None:
            return normals @ self.light
        cosine = np.sum(normals * self.spot.toward(points), axis=-1)
        return (cosine * self.spot.falloff(points) * self.spot.spot_factor(points)).astype(np.float32)

    def lit(self, points: Float[np.ndarray, "S 3"], receiver: int | None) -> Float[np.ndarray, "S"]:
        """Return 1 where the light reaches world points, 0 where a body (also the receiver itself) stands in the way.

        Args:
            points: on a surface [m].
            receiver: number of the body whose surface it is; None for the table.
        """
        lit = np.ones(len(points), np.float32)
        for i, body in enumerate(self.bodies):
            candidates = np.nonzero(lit if i == receiver else (lit > 0) & self._may_shade(body, points))[0]
            if len(candidates):
                rays, end = self._to_light(points[candidates])
                blocked = body.mesh.occludes(*into_frame(body.pose, points[candidates], rays), end)
                lit[candidates[blocked]] = 0
        return lit

    def _to_light(self, points: Float[np.ndarray, "S 3"]) -> tuple[Float[np.ndarray, "S 3"], float | None]:
        """Return rays from points toward the light, and where they end [ray lengths]."""
        if self.spot is None:
            return np.broadcast_to(self.light, points.shape), None
        return self.spot.position.astype(np.float32) - points, 1.0

    def _may_shade(self, body: Body, points: Float[np.ndarray, "S 3"]) -> Bool[np.ndarray, "S"]:
        """Return whether the ray from each point toward the light passes through the body's bounding sphere."""
        to_centre, radius = body.pose.position.astype(np.float32) - points, body.mesh.radius_m
        if self.spot is None:
            along = to_centre @ self.light
            across2 = np.einsum("ij,ij->i", to_centre, to_centre) - along**2
            return (across2 < radius**2) & (along > -radius)
        rays, _ = self._to_light(points)
        share = np.einsum("ij,ij->i", to_centre, rays) / np.einsum("ij,ij->i", rays, rays)
        nearest = to_centre - np.clip(share, 0, 1)[:, None] * rays
        return np.einsum("ij,ij->i", nearest, nearest) < radius**2


# A wooden table: boards side by side, with grain, year rings and dark joints, drawn at random.


_ROWS = 10  # of boards across the table
_TONE = 0.07  # by which boards differ (standard deviation), as a share of their brightness
_RING, _GRAIN = 0.10, 0.05  # amplitude of year rings and standard deviation of grain, as shares
_JOINT = 0.45  # brightness of the gap between boards
_DARKER = (0.85, 1.0, 1.2)  # dark wood is redder: blue loses more than red


def wooden_texture(rng: np.random.Generator, side: int = 1024) -> Float[np.ndarray, "side side 3"]:
    """Draw an albedo for a `TableSurface` whose mean is about that of the usual table.

    Args:
        rng: draws the boards.
        side: side of the texture [texels].
    """
    edges = np.round(np.linspace(0, side, _ROWS + 1)).astype(int)
    shade = np.empty((side, side), np.float32)
    for top, bottom in pairwise(edges):
        end = int(rng.integers(side // 5, side - side // 5))  # of the row's first board
        shade[top:bottom, :end] = _board(rng, bottom - top, end, side)
        shade[top:bottom, end:] = _board(rng, bottom - top, side - end, side)
    contrast = (shade - shade.mean())[..., None] * np.array(_DARKER, np.float32)
    texture = np.array(TABLE_ALBEDO, np.float32) * (1 + contrast)
    return np.clip(texture, 0, 1).astype(np.float32)


def _board(rng: np.random.Generator, height: int, width: int, side: int) -> Float[np.ndarray, "height width"]:
    """Draw the relative brightness of one board along x, less 1, with a joint at its top and left."""
    texel = 1024 / side  # sizes below are in texels of a texture of 1024
    y = np.arange(height)[:, None] * texel
    bent = y + 9 * _noise(rng, height, width, 40 / texel, 250 / texel)  # rings meander along the board
    rings = np.sin(2 * np.pi * bent / rng.uniform(12, 26) + rng.uniform(0, 2 * np.pi))
    grain = _noise(rng, height, width, 2 / texel, 90 / texel)
    shade = _TONE * rng.standard_normal() + _RING * rings * np.abs(rings) + _GRAIN * grain
    gap = max(round(2 / texel), 1)
    shade[:gap], shade[:, :gap] = _JOINT - 1, _JOINT - 1
    return shade.astype(np.float32)


def _noise(rng: np.random.Generator, height: int, width: int, across: float, along: float) -> np.ndarray:
    """Draw smooth noise of standard deviation 1 with these correlation lengths across and along the board [texels]."""
    coarse = rng.standard_normal((round(height / across) + 2, round(width / along) + 2))
    smooth = cv2.resize(coarse, (width, height), interpolation=cv2.INTER_CUBIC)
    return smooth / max(smooth.std(), 1e-9)


# The table along rays: where they meet it, in light or in shadow, and how bright; the open table without sampling.


_BACKGROUND = -1.0
_UP = np.array([0, 0, 1], np.float32)


def _see_table(
    shot: Shot, directions: Float[np.ndarray, "S 3"]
) -> tuple[Float[np.ndarray, "S"], Float[np.ndarray, "S 3"], Float[np.ndarray, "S"]]:
    """Trace rays that no body stops.

    Returns:
        Background (-1), table in shadow (0) or in light (1); radiance; depth along the camera's z axis [m], infinite
        beside the table.
    """
    origin = shot.origin
    falling = (directions[:, 2] < -1e-9) & (origin[2] > 0)  # a camera below the table sees no table
    depth = np.where(falling, -origin[2] / np.where(falling, directions[:, 2], -1), np.inf).astype(np.float32)
    points = origin + np.where(falling, depth, 0)[:, None] * directions
    half = TABLE_SIDE_M / 2
    on_table = np.isfinite(depth) & (np.abs(points[:, 0]) <= half) & (np.abs(points[:, 1]) <= half)
    kind = np.full(len(depth), _BACKGROUND, np.float32)
    kind[on_table] = shot.lit(points[on_table], None)
    colour = np.full((len(depth), 3), BACKGROUND_RADIANCE, np.float32)
    colour[on_table] = _radiance(shot, _albedo(shot, points[on_table, :2]), points[on_table], kind[on_table])
    return kind, colour, np.where(on_table, depth, np.inf).astype(np.float32)


def _open_table(shot: Shot, near_body: Bool[np.ndarray, "h w"], picture: Picture) -> Bool[np.ndarray, "h w"]:
    """Fill pixels without body from their four corners; return those whose corners disagree.

    A pixel whose corners agree is all in light or all in shadow. There only a texture and a near lamp's light, which
    change from place to place, are sampled.
    """
    corner = (near_body.shape[0] + 1, near_body.shape[1] + 1)
    kind, colour, distance = _see_table(shot, shot.directions(_grid(0, 0, corner[1], corner[0])))
    kind, distance = kind.reshape(corner), distance.reshape(corner)
    corners = np.stack([kind[:-1, :-1], kind[:-1, 1:], kind[1:, :-1], kind[1:, 1:]])
    busy = np.any(corners[1:] != corners[0], axis=0)
    picture.rgb[:] = colour.reshape(*corner, 3)[:-1, :-1]
    picture.depth[:] = (distance[:-1, :-1] + distance[:-1, 1:] + distance[1:, :-1] + distance[1:, 1:]) / 4
    if shot.spot is not None or (shot.table is not None and shot.table.texture is not None):
        _fill_open(shot, (corners[0] != _BACKGROUND) & ~busy & ~near_body, corners[0], picture.rgb)
    return busy


def _fill_open(shot: Shot, pixels: Bool[np.ndarray, "h w"], kind: np.ndarray, rgb: np.ndarray) -> None:
    """Fill pixels that show nothing but table; `kind` is 1 for those in light and 0 for those in shadow."""
    for samples in shot.sampled(pixels):
        points = cv2.perspectiveTransform(samples.points[None], _pixels_to_table(shot))[0]
        chosen, albedo = (samples.rows, samples.columns), _albedo(shot, points)
        if shot.spot is None:  # light is the same all over the table
            rgb[chosen] = _radiance(shot, samples.means(albedo), points, kind[chosen])
        else:
            points = np.pad(points, ((0, 0), (0, 1)))
            lit = np.repeat(kind[chosen], shot.samples**2)
            rgb[chosen] = samples.means(_radiance(shot, albedo, points, lit))


def _pixels_to_table(shot: Shot) -> Float[np.ndarray, "3 3"]:
    """Return the homography from pixels to the table's plane [m]: a ray o + t d meets it at o - d o_z / d_z."""
    d, o = shot.pixels_to_world, shot.camera.T_world_camera.position
    return np.stack([o[0] * d[2] - o[2] * d[0], o[1] * d[2] - o[2] * d[1], d[2]])


def _albedo(shot: Shot, points: Float[np.ndarray, "S 2"]) -> Float[np.ndarray, "S 3"]:
    """Return the albedo of points of the table, averaged over the distance of samples in the table's middle."""
    assert shot.table is not None  # for the type checker: only views of a table come here
    spacing_m = float(np.linalg.norm(shot.origin)) / float(shot.camera.intrinsics[1, 1]) / shot.samples
    return shot.table.albedo_at(points, 0.0 if shot.sharp else spacing_m)


def _radiance(
    shot: Shot, albedo: Float[np.ndarray, "S 3"], points: Float[np.ndarray, "_ _"], visible: Float[np.ndarray, "S"]
) -> Float[np.ndarray, "S 3"]:
    """Return the radiance of the table; its points [m] matter under a near lamp alone."""
    incidence = np.full(len(albedo), shot.light[2], np.float32) if shot.spot is None else shot.incidence(points, _UP)
    return lambert(albedo, incidence, visible, shot.lamp)


# Pictures of a tabletop: anti-aliased, textured, with exact shadows of a parallel light or a near lamp.
#
# This is the image model of object image sets, scenes and goals alike. Pixels that an object may cover, and those
# that a shadow's or the table's edge crosses, take a grid of samples each; the open table is known in closed form.


DEFAULT_SAMPLES = 3  # samples along each side of a pixel, in images of 96 pixels and more
_SMALL_SIDE = 96  # below, bodies may be thinner than a pixel: corners miss them and three samples are too few
_BIAS_M = np.float32(5e-4)  # shadow rays start this far above curved facets, which smooth normals make look round


@dataclass(frozen=True, eq=False, slots=True)
class Picture:
    """One traced view.

    Attributes:
        rgb: mean radiance of each pixel, linear; black around an object traced alone.
        coverage: visible share of each pixel per body, objects in the state's order, then the pusher if there is one.
        depth: mean distance along the camera's z axis over what was hit [m]; infinite where nothing was.
    """

    rgb: Float[np.ndarray, "h w 3"]
    coverage: Float[np.ndarray, "N h w"]
    depth: Float[np.ndarray, "h w"]


@dataclass(frozen=True, eq=False)
class RayTracer:
    """Traces views of scenes made of known meshes.

    Attributes:
        meshes: the objects that scenes may name.
        lamp: strengths of ambient and diffuse light, and their colour.
        table: the look of the table.
        spot: a near lamp in the place of the light of every state.
        executor: traces the views of one call side by side, if given (threads serve: Embree releases the GIL).
    """

    meshes: Mapping[str, TracedMesh]
    _: KW_ONLY
    lamp: Lamp = Lamp()
    table: TableSurface = TableSurface()
    spot: SpotLamp | None = None
    executor: Executor | None = None
    _pusher: TracedMesh = field(init=False, repr=False, default_factory=lambda: TracedMesh(pusher_mesh()))

    def render(
        self, state: SceneState, cameras: tuple[Camera, ...], *, samples: int | None = None, sharp: bool = False
    ) -> tuple[Picture, ...]:
        """Trace the state from each camera.

        Args:
            state: objects, light and pusher (drawn if it is not None).
            cameras: the views.
            samples: samples along each side of a pixel; by default 3, and more in small images.
            sharp: take textures at their finest level and sample every pixel alike: slow, a reference.

        Raises:
            KeyError: if the state names an object without mesh.
        """
        bodies = [Body(self.meshes[name], state.poses[i]) for i, name in enumerate(state.names)]
        if state.pusher is not None:
            bodies.append(Body(self._pusher, Pose(state.pusher, Pose.identity().quaternion)))
        light = state.light.direction.astype(np.float32)
        shots = [
            Shot(tuple(bodies), light, camera, self.lamp, self.table, samples or _samples_for(camera), sharp, self.spot)
            for camera in cameras
        ]
        return tuple(map(_trace, shots) if self.executor is None else self.executor.map(_trace, shots))

    def render_alone(
        self, name: str, light_direction: Float[np.ndarray, "3"], camera: Camera, *, samples: int = DEFAULT_SAMPLES
    ) -> Picture:
        """Trace one object at the origin, floating in black nothing, lit from any direction, from below as well.

        Args:
            name: which object.
            light_direction: unit vector toward the light, in the object's frame.
            camera: a view, in the object's frame.
            samples: samples along each side of a pixel.
        """
        bodies = (Body(self.meshes[name], Pose.identity()),)
        light = np.asarray(light_direction, np.float32)
        return _trace(Shot(bodies, light, camera, self.lamp, None, samples, False))


def _samples_for(camera: Camera) -> int:
    side = min(camera.width, camera.height)
    if side >= _SMALL_SIDE:
        return DEFAULT_SAMPLES
    return 4 if side >= 48 else 6 if side >= 24 else 8


def masks_of(picture: Picture, count: int) -> Bool[np.ndarray, "N h w"]:
    """Return masks of the first `count` bodies: a pixel is of the body that covers most of it, if half or more."""
    coverage = picture.coverage[:count]
    if count == 0:
        return np.zeros(coverage.shape, bool)
    winner = np.arange(count)[:, None, None] == coverage.argmax(axis=0)
    return winner & (coverage >= 0.5)


def _trace(shot: Shot) -> Picture:
    """Trace one view: the closed-form table first, then grids of samples where bodies or edges are."""
    height, width = shot.camera.height, shot.camera.width
    near_body = np.ones((height, width), bool) if shot.sharp else _near_bodies(shot)
    picture = Picture(
        np.zeros((height, width, 3), np.float32),
        np.zeros((len(shot.bodies), height, width), np.float32),
        np.full((height, width), np.inf, np.float32),
    )
    if shot.table is not None:
        busy = _open_table(shot, near_body, picture)
        _sample(shot, busy & ~near_body, (), picture)
    _sample(shot, near_body, tuple(range(len(shot.bodies))), picture)
    return picture


def _near_bodies(shot: Shot) -> Bool[np.ndarray, "h w"]:
    """Find pixels that a body may cover: those with a corner on one, and their neighbours."""
    height, width = shot.camera.height, shot.camera.width
    on_body = np.zeros((height + 1, width + 1), bool)
    for body in shot.bodies:
        box = body.mesh.screen_box(body.pose, shot.camera)
        if box is None:
            continue
        left, top, right, bottom = box
        corners = on_body[top : bottom + 1, left : right + 1]
        if min(height, width) < _SMALL_SIDE:
            corners[:] = True
            continue
        directions = shot.directions(_grid(left, top, right + 1, bottom + 1))
        origins = np.broadcast_to(shot.origin, directions.shape)
        corners |= body.mesh.occludes(*into_frame(body.pose, origins, directions)).reshape(corners.shape)
    pixels = on_body[:-1, :-1] | on_body[:-1, 1:] | on_body[1:, :-1] | on_body[1:, 1:]
    return cv2.dilate(pixels.astype(np.uint8), np.ones((3, 3), np.uint8)).astype(bool)


def _grid(left: int, top: int, right: int, bottom: int) -> Float[np.ndarray, "S 2"]:
    """Return the pixel coordinates of the corners in a rectangle, row by row; right and bottom are excluded."""
    y, x = np.mgrid[top:bottom, left:right]
    return np.stack([x, y], axis=-1).reshape(-1, 2).astype(np.float32)


def _sample(shot: Shot, pixels: Bool[np.ndarray, "h w"], visible: tuple[int, ...], picture: Picture) -> None:
    """Fill the chosen pixels with the mean of a grid of samples; `visible` are the bodies they may show."""
    for samples in shot.sampled(pixels):
        chosen = samples.rows, samples.columns
        colour, z, owner = _shade(shot, samples.points, visible)
        picture.rgb[chosen] = samples.means(colour)
        hit = np.isfinite(z)
        share = samples.means(hit[:, None].astype(np.float32))[:, 0]
        total = samples.means(np.where(hit, z, 0)[:, None])[:, 0]
        picture.depth[chosen] = np.where(share > 0, total / np.maximum(share, 1e-6), np.inf)
        owned = owner[:, None] == np.array(visible)
        places = visible, samples.rows[:, None], samples.columns[:, None]
        picture.coverage[places] = samples.means(owned.astype(np.float32))


def _shade(
    shot: Shot, points: Float[np.ndarray, "S 2"], visible: tuple[int, ...]
) -> tuple[Float[np.ndarray, "S 3"], Float[np.ndarray, "S"], np.ndarray]:
    """Compute radiance, depth and owner (index of the body, or -1) of the samples at pixel coordinates."""
    directions = shot.directions(points)
    nearest = np.full(len(points), np.inf, np.float32)
    owner = np.full(len(points), -1)
    face = np.zeros(len(points), np.int64)
    barycentric = np.zeros((len(points), 2), np.float32)
    for i in visible:
        body = shot.bodies[i]
        inside = np.arange(len(points)) if shot.sharp else _inside_box(shot, body, points)
        if len(inside) == 0:
            continue
        origins = np.broadcast_to(shot.origin, (len(inside), 3))
        distance, hit_face, hit_uv = body.mesh.intersect(*into_frame(body.pose, origins, directions[inside]))
        closer = distance < nearest[inside]
        chosen = inside[closer]
        nearest[chosen], owner[chosen] = distance[closer], i
        face[chosen], barycentric[chosen] = hit_face[closer], hit_uv[closer]
    colour = np.zeros((len(points), 3), np.float32)
    depth = np.full(len(points), np.inf, np.float32)
    if shot.table is not None:
        # Bodies stand on the table, so it is only seen where no body was hit, or below the table.
        owner[(owner >= 0) & ~_above_table(shot, directions, nearest)] = -1
        open_rays = np.nonzero(owner < 0)[0]
        _, colour[open_rays], depth[open_rays] = _see_table(shot, directions[open_rays])
    for i in visible:
        mine = np.nonzero(owner == i)[0]
        if len(mine):
            colour[mine] = _body_colour(shot, i, directions[mine], nearest[mine], face[mine], barycentric[mine])
            depth[mine] = nearest[mine]
    return colour, depth, owner


def _above_table(shot: Shot, directions: np.ndarray, distance: np.ndarray) -> Bool[np.ndarray, "S"]:
    """Return which hits lie above the table's plane: a body that sinks in a little does not shine through."""
    z = shot.origin[2] + np.where(np.isfinite(distance), distance, 0) * directions[:, 2]
    return z > -1e-4 if shot.origin[2] > 0 else np.ones(len(z), bool)


def _inside_box(shot: Shot, body: Body, points: Float[np.ndarray, "S 2"]) -> np.ndarray:
    """Return the indices of pixel coordinates inside a body's rectangle."""
    box = body.mesh.screen_box(body.pose, shot.camera)
    if box is None:
        return np.zeros(0, np.int64)
    left, top, right, bottom = box
    x, y = points.T
    return np.nonzero((x >= left) & (x < right) & (y >= top) & (y < bottom))[0]


def _body_colour(
    shot: Shot, index: int, directions: np.ndarray, distance: np.ndarray, face: np.ndarray, barycentric: np.ndarray
) -> Float[np.ndarray, "S 3"]:
    """Compute the radiance of hits on one body."""
    body = shot.bodies[index]
    rotation = quaternion_to_matrix(body.pose.quaternion).astype(np.float32)
    local_normals, uv = body.mesh.surface(face, barycentric, directions @ rotation)
    normals = local_normals @ rotation.T
    spacing_m = float(distance.mean()) / shot.camera.intrinsics[1, 1] / shot.samples
    albedo = body.mesh.albedo(uv, 0.0 if shot.sharp else spacing_m)
    points = shot.origin + distance[:, None] * directions
    incidence = shot.incidence(points, normals)
    visible = np.zeros(len(distance), np.float32)
    facing = np.nonzero(incidence > 0)[0]
    visible[facing] = shot.lit(points[facing] + _BIAS_M * normals[facing], index)
    matte = lambert(albedo, incidence, visible, shot.lamp)
    if shot.lamp.specular == 0 or shot.spot is not None:
        return matte
    return matte + highlight(normals, directions, shot.light, visible, shot.lamp)
