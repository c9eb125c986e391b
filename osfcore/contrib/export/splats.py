"""A field as Gaussian splats (Kerbl et al. 2023): flat discs on its surface, with the lighting baked in.

The file is the PLY that 3D Gaussian splatting writes and viewers read, of spherical harmonics of degree 0:

    x y z  nx ny nz  f_dc_0..2  opacity  scale_0..2  rot_0..3                               float32 each

with colour = 1/2 + C0 f_dc, opacity = sigmoid(opacity), standard deviations = exp(scale) [m] along the axes of the unit
quaternion rot (w, x, y, z).
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import trimesh
from jaxtyping import Float32
from scipy.spatial import KDTree

from osfcore.contrib.export.meshes import baked
from osfcore.dynamics.shapes import field_mesh
from osfcore.fields.kiloosf import KiloOSF
from osfcore.geometry.light import AMBIENT, DIFFUSE, Light

SH_C0 = 0.5 / np.sqrt(np.pi)  # the spherical harmonic of degree 0
_OPACITY = 0.95  # of every disc
_NEIGHBOURS = 6
_WIDTH, _THICKNESS = 0.45, 0.1  # standard deviations across and along the normal, per distance to the neighbours
_FIELDS = (
    *("x", "y", "z", "nx", "ny", "nz", "f_dc_0", "f_dc_1", "f_dc_2", "opacity"),
    *("scale_0", "scale_1", "scale_2", "rot_0", "rot_1", "rot_2", "rot_3"),
)


@dataclass(frozen=True, eq=False, slots=True)
class Splats:
    """Gaussians in the field's frame.

    Attributes:
        means: centres [m].
        normals: unit, outward.
        colours: in [0, 1], the same from all sides.
        deviations: along each Gaussian's own axes [m].
        quaternions: from its axes to the field's frame (w, x, y, z); its z axis is the normal.
        light: under which the colours are.
    """

    means: Float32[np.ndarray, "S 3"]
    normals: Float32[np.ndarray, "S 3"]
    colours: Float32[np.ndarray, "S 3"]
    deviations: Float32[np.ndarray, "S 3"]
    quaternions: Float32[np.ndarray, "S 4"]
    light: Light


def field_splats(field: KiloOSF, light: Light) -> Splats:
    """Place a disc below each vertex of the field's surface, after each of its triangles is cut into four.

    Colours are the radiance along the normal: splats of degree 0 change neither with the view nor with the light. The
    width of a disc follows the mean distance to its six nearest neighbours, as in the initialization of Kerbl et al.

    Args:
        field: of the object.
        light: toward it, in the field's frame.

    Raises:
        InvalidInput: if nothing in the field is solid.
    """
    mesh = trimesh.Trimesh(*field_mesh(field), process=False).subdivide()
    normals = np.array(mesh.vertex_normals)
    points, colours = baked(field, np.array(mesh.vertices), normals, light)
    distances, _ = KDTree(points).query(points, k=_NEIGHBOURS + 1)
    spacing = distances[:, 1:].mean(axis=1, keepdims=True)
    deviations = (spacing * (_WIDTH, _WIDTH, _THICKNESS)).astype(np.float32)
    # The shortest rotations from z to unit vectors n are (1 + n_z, -n_y, n_x, 0), normalized.
    q = np.stack([1 + normals[:, 2], -normals[:, 1], normals[:, 0], 0 * normals[:, 0]], axis=1)
    q[normals[:, 2] < -1 + 1e-6] = (0, 1, 0, 0)  # straight down: half a turn about x
    quaternions = (q / np.linalg.norm(q, axis=1, keepdims=True)).astype(np.float32)
    return Splats(points, normals.astype(np.float32), colours, deviations, quaternions, light)


def splats_ply(splats: Splats) -> bytes:
    """Encode a binary PLY; its comments name the light that is baked in."""
    x, y, z = splats.light.direction
    header = (
        "ply",
        "format binary_little_endian 1.0",
        f"comment Lighting is baked in: light toward ({x:.4f}, {y:.4f}, {z:.4f}), "
        f"ambient {AMBIENT:g}, diffuse {DIFFUSE:g}; it cannot be lit anew.",
        "comment Object frame, z up, metres.",
        f"element vertex {len(splats.means)}",
        *(f"property float {name}" for name in _FIELDS),
        "end_header\n",
    )
    columns = (
        splats.means,
        splats.normals,
        (splats.colours - 0.5) / SH_C0,
        np.full((len(splats.means), 1), np.log(_OPACITY / (1 - _OPACITY))),
        np.log(splats.deviations),
        splats.quaternions,
    )
    return "\n".join(header).encode("ascii") + np.concatenate(columns, axis=1).astype("<f4").tobytes()
