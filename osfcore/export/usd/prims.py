"""Meshes, cameras and the light as prims of a USD stage with z up [m]."""

from __future__ import annotations

import numpy as np
import trimesh
from jaxtyping import Float
from pxr import Gf, Sdf, Tf, Usd, UsdGeom, UsdLux, Vt
from trimesh.visual import ColorVisuals, TextureVisuals

from osfcore.geometry.cameras import Camera
from osfcore.geometry.light import AMBIENT, DIFFUSE, Light
from osfcore.geometry.poses import orthogonal_basis

_OPENCV_TO_USD = np.diag([1.0, -1, -1, 1])  # USD's cameras look along -z with y up
_FILM = 0.36  # width of the film in tenths of a metre, in which USD has it: 36 mm
_SEEN_M = (0.01, 100.0)


class Names:
    """Paths of prims below /World for names of any characters, each path once."""

    def __init__(self) -> None:
        self._shown: dict[Sdf.Path, str] = {}

    def take(self, name: str) -> Sdf.Path:
        """A free path for a name."""
        start = name if name[:1].isalpha() else f"_{name}"  # 006 would become _06
        stem, count = Tf.MakeValidIdentifier(start), 1
        path = Sdf.Path(f"/World/{stem}")
        while path in self._shown:
            count += 1
            path = Sdf.Path(f"/World/{stem}_{count}")
        self._shown[path] = name
        return path

    def show(self, stage: Usd.Stage) -> None:
        """Let the prims tell their exact names."""
        for path, name in self._shown.items():
            stage.GetPrimAtPath(path).SetDisplayName(name)


def add_mesh(stage: Usd.Stage, path: Sdf.Path, mesh: trimesh.Trimesh, matrix: Float[np.ndarray, "4 4"]) -> UsdGeom.Mesh:
    """Triangles with smooth normals; texture coordinates or colours for each vertex, whichever there are."""
    prim = UsdGeom.Mesh.Define(stage, path)
    _place(prim, matrix)
    points = np.asarray(mesh.vertices, np.float32)
    prim.CreatePointsAttr(Vt.Vec3fArray.FromNumpy(points))
    prim.CreateExtentAttr(Vt.Vec3fArray.FromNumpy(np.stack([points.min(axis=0), points.max(axis=0)])))
    prim.CreateFaceVertexCountsAttr(Vt.IntArray.FromNumpy(np.full(len(mesh.faces), 3, np.int32)))
    prim.CreateFaceVertexIndicesAttr(Vt.IntArray.FromNumpy(np.asarray(mesh.faces, np.int32).ravel()))
    prim.CreateNormalsAttr(Vt.Vec3fArray.FromNumpy(np.array(mesh.vertex_normals, np.float32)))
    prim.SetNormalsInterpolation(UsdGeom.Tokens.vertex)
    prim.CreateSubdivisionSchemeAttr(UsdGeom.Tokens.none)
    kind, primvars = UsdGeom.Tokens.vertex, UsdGeom.PrimvarsAPI(prim)
    if isinstance(mesh.visual, TextureVisuals):
        uv = Vt.Vec2fArray.FromNumpy(np.array(mesh.visual.uv, np.float32))
        primvars.CreatePrimvar("st", Sdf.ValueTypeNames.TexCoord2fArray, kind).Set(uv)
    elif isinstance(mesh.visual, ColorVisuals):
        colours = np.asarray(mesh.visual.vertex_colors, np.float32)[:, :3] / 255  # linear, as USD has them
        prim.CreateDisplayColorPrimvar(kind).Set(Vt.Vec3fArray.FromNumpy(np.ascontiguousarray(colours)))
    return prim


def add_camera(stage: Usd.Stage, path: Sdf.Path, camera: Camera) -> None:
    """A pinhole camera with exactly its K: the film is shifted where the principal point is not in the middle."""
    prim, K = UsdGeom.Camera.Define(stage, path), camera.intrinsics
    _place(prim, camera.T_world_camera.matrix() @ _OPENCV_TO_USD)
    focal = _FILM * K[0, 0] / camera.width
    prim.CreateFocalLengthAttr(focal)
    prim.CreateHorizontalApertureAttr(_FILM)
    prim.CreateVerticalApertureAttr(focal * camera.height / K[1, 1])
    prim.CreateHorizontalApertureOffsetAttr(focal * (camera.width / 2 - K[0, 2]) / K[0, 0])
    prim.CreateVerticalApertureOffsetAttr(focal * (K[1, 2] - camera.height / 2) / K[1, 1])
    prim.CreateClippingRangeAttr(Gf.Vec2f(*_SEEN_M))


def add_light(stage: Usd.Stage, names: Names, light: Light) -> None:
    """The parallel light and the ambient one, under which a white matte surface sends out 0.75 and 0.25.

    A distant light of angle 0 has the illuminance of its intensity: 0.75 pi. A dome of radiance 0.25 lights everything
    evenly.

    Deviation: objects keep light of the dome from each other, in renderers that follow it, which they do not here.
    """
    distant = UsdLux.DistantLight.Define(stage, names.take("light"))
    right, up = orthogonal_basis(light.direction)
    matrix = np.eye(4)
    matrix[:3] = np.stack([right, up, light.direction, light.position], axis=1)  # it shines along -z
    _place(distant, matrix)
    distant.CreateAngleAttr(0.0)  # hard shadows
    distant.CreateIntensityAttr(DIFFUSE * np.pi)
    distant.CreateNormalizeAttr(True)
    UsdLux.DomeLight.Define(stage, names.take("ambient light")).CreateIntensityAttr(AMBIENT)


def _place(prim: UsdGeom.Xformable, matrix: Float[np.ndarray, "4 4"]) -> None:
    prim.AddTransformOp().Set(Gf.Matrix4d(np.asarray(matrix, float).T.tolist()))  # of rows of points, from the left
