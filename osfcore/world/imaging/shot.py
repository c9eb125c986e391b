"""One view to trace: which bodies, from where, under which light; its rays and shadows."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float, Int

from osfcore.geometry.cameras import Camera
from osfcore.geometry.poses import Pose, quaternion_to_matrix
from osfcore.geometry.spot_lamp import SpotLamp
from osfcore.world.imaging.optics import Lamp, TableSurface
from osfcore.world.imaging.traced_mesh import TracedMesh, into_frame

_CHUNK = 1 << 17  # samples traced at once, to bound memory at large image sizes


@dataclass(frozen=True, eq=False, slots=True)
class Body:
    """A mesh at its place in one scene.

    Attributes:
        mesh: what rays meet.
        pose: T_world_object.
    """

    mesh: TracedMesh
    pose: Pose


@dataclass(frozen=True, eq=False, slots=True)
class PixelSamples:
    """A grid of samples in each of some pixels.

    Attributes:
        rows: of the pixels.
        columns: of the pixels.
        points: pixel coordinates of the samples [px], those of one pixel after those of another.
    """

    rows: Int[np.ndarray, "P"]
    columns: Int[np.ndarray, "P"]
    points: Float[np.ndarray, "S 2"]

    def means(self, values: Float[np.ndarray, "S C"]) -> Float[np.ndarray, "P C"]:
        """Means over each pixel's samples, as a matrix product: numpy reduces short axes slowly."""
        channels, pixels = values.shape[1], len(self.rows)
        per_pixel = len(values) // pixels
        average = np.tile(np.eye(channels, dtype=np.float32), (per_pixel, 1)) / np.float32(per_pixel)
        return values.reshape(pixels, per_pixel * channels) @ average


@dataclass(frozen=True, eq=False, slots=True)
class Shot:
    """One view to trace.

    Attributes:
        bodies: what is in the scene.
        light: unit vector toward the light, float32.
        camera: the view.
        lamp: how strongly, and in which colour, the scene is lit.
        table: what the table looks like; None where there is none.
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
        """Maps homogeneous pixel coordinates to directions in the world."""
        inverse = np.linalg.inv(self.camera.intrinsics)
        return quaternion_to_matrix(self.camera.T_world_camera.quaternion) @ inverse

    def directions(self, points: Float[np.ndarray, "S 2"]) -> Float[np.ndarray, "S 3"]:
        """World directions through pixel coordinates, scaled so that the ray parameter is the depth along z."""
        homogeneous = np.concatenate([points, np.ones((len(points), 1), np.float32)], axis=1)
        return homogeneous @ self.pixels_to_world.T.astype(np.float32)

    def sampled(self, pixels: Bool[np.ndarray, "h w"]) -> Iterator[PixelSamples]:
        """Grids of samples in the chosen pixels, some pixels at a time."""
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
        """Cosine of the light's angle to the normals at points, times a near lamp's falloff and cone."""
        if self.spot is None:
            return normals @ self.light
        cosine = np.sum(normals * self.spot.toward(points), axis=-1)
        return (cosine * self.spot.falloff(points) * self.spot.spot_factor(points)).astype(np.float32)

    def lit(self, points: Float[np.ndarray, "S 3"], receiver: int | None) -> Float[np.ndarray, "S"]:
        """1 where the light reaches world points, 0 where a body stands in the way (the receiver itself included).

        Args:
            points: on a surface [m].
            receiver: number of the body whose surface it is; None for the table.
        """
        lit = np.ones(len(points), np.float32)
        for i, body in enumerate(self.bodies):
            if i == receiver:
                candidates = np.nonzero(lit)[0]
            else:
                candidates = np.nonzero((lit > 0) & self._may_shade(body, points))[0]
            if len(candidates):
                rays, end = self._to_light(points[candidates])
                blocked = body.mesh.occludes(*into_frame(body.pose, points[candidates], rays), end)
                lit[candidates[blocked]] = 0
        return lit

    def _to_light(self, points: Float[np.ndarray, "S 3"]) -> tuple[Float[np.ndarray, "S 3"], float | None]:
        """Rays from points toward the light, and where they end [ray lengths]."""
        if self.spot is None:
            return np.broadcast_to(self.light, points.shape), None
        return self.spot.position.astype(np.float32) - points, 1.0

    def _may_shade(self, body: Body, points: Float[np.ndarray, "S 3"]) -> Bool[np.ndarray, "S"]:
        """Whether the ray from each point toward the light passes through the body's bounding sphere."""
        to_centre, radius = body.pose.position.astype(np.float32) - points, body.mesh.radius_m
        if self.spot is None:
            along = to_centre @ self.light
            across2 = np.einsum("ij,ij->i", to_centre, to_centre) - along**2
            return (across2 < radius**2) & (along > -radius)
        rays, _ = self._to_light(points)
        share = np.einsum("ij,ij->i", to_centre, rays) / np.einsum("ij,ij->i", rays, rays)
        nearest = to_centre - np.clip(share, 0, 1)[:, None] * rays
        return np.einsum("ij,ij->i", nearest, nearest) < radius**2
