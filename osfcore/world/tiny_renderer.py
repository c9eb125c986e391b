"""Pictures by PyBullet's TinyRenderer, as in the paper: a choice beside ray tracing and the yardstick for speed.

Its shadow is not the image model's: it removes about a fifth of the diffuse term, depends on the camera and is falsely
dark at low light. Nothing is trained on it.
"""

from __future__ import annotations

import tempfile
from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np

from osfcore.geometry.cameras import Camera
from osfcore.geometry.poses import Pose
from osfcore.geometry.states import SceneState
from osfcore.geometry.workspace import TABLE_SIDE_M
from osfcore.objects.asset import ObjectAsset, TexturedMesh
from osfcore.world.bullet_physics import BulletClient, pybullet
from osfcore.world.imaging import BACKGROUND_RADIANCE, TABLE_ALBEDO, Lamp, Picture, pusher_mesh

_NEAR_M, _FAR_M = 0.05, 5.0
_LIGHT_DISTANCE_M = 3.0


class TinyScene:
    """Visual bodies of some objects, the table and the pusher in a PyBullet client of their own.

    Args:
        assets: the objects that states may name.
        shadow: whether TinyRenderer draws its shadow.
    """

    def __init__(self, assets: Mapping[str, ObjectAsset], *, shadow: bool = True) -> None:
        self._bullet = BulletClient()
        self._shadow = shadow
        half = [TABLE_SIDE_M / 2, TABLE_SIDE_M / 2, 0.01]
        table = self._bullet.createVisualShape(pybullet.GEOM_BOX, halfExtents=half, rgbaColor=[*TABLE_ALBEDO, 1])
        self._bullet.createMultiBody(0, -1, table, [0, 0, -half[2]])
        self._pusher = self._textured(pusher_mesh())
        self._bodies = {name: self._textured(asset.mesh) for name, asset in assets.items()}

    def close(self) -> None:
        """Free the client."""
        self._bullet.disconnect()

    def render(self, state: SceneState, cameras: tuple[Camera, ...]) -> tuple[Picture, ...]:
        """Draw a state; coverage is 0 or 1, for TinyRenderer does not smooth edges."""
        gone = Pose(np.array([0.0, 0.0, -100.0]), Pose.identity().quaternion)  # out of sight
        for name, body in self._bodies.items():
            self._place(body, state.pose(name) if name in state.names else gone)
        uids = [self._bodies[name] for name in state.names]
        if state.pusher is not None:
            uids.append(self._pusher)
        self._place(self._pusher, gone if state.pusher is None else replace(gone, position=state.pusher))
        return tuple(self._picture(state, camera, uids) for camera in cameras)

    def _picture(self, state: SceneState, camera: Camera, uids: list[int]) -> Picture:
        lamp = Lamp()
        _, _, rgba, depth, segments = self._bullet.getCameraImage(
            camera.width,
            camera.height,
            (np.diag([1.0, -1.0, -1.0, 1.0]) @ camera.T_world_camera.inverse().matrix()).T.ravel().tolist(),
            _projection_matrix(camera),
            lightDirection=(state.light.direction * _LIGHT_DISTANCE_M).tolist(),
            lightColor=[1, 1, 1],
            lightDistance=_LIGHT_DISTANCE_M,
            lightAmbientCoeff=lamp.ambient,
            lightDiffuseCoeff=lamp.diffuse,
            lightSpecularCoeff=0,
            shadow=int(self._shadow),
            renderer=pybullet.ER_TINY_RENDERER,
        )
        shape = (camera.height, camera.width)
        rgb = np.reshape(np.asarray(rgba, np.uint8), (*shape, 4))[..., :3].astype(np.float32) / 255
        segments = np.reshape(np.asarray(segments), shape)
        rgb[segments < 0] = BACKGROUND_RADIANCE
        z = np.reshape(np.asarray(depth, np.float32), shape)
        metres = _FAR_M * _NEAR_M / (_FAR_M - (_FAR_M - _NEAR_M) * z)
        coverage = np.stack([segments == uid for uid in uids]) if uids else np.zeros((0, *shape))
        return Picture(rgb, coverage.astype(np.float32), np.where(segments < 0, np.inf, metres).astype(np.float32))

    def _place(self, uid: int, pose: Pose) -> None:
        w, x, y, z = pose.quaternion
        self._bullet.resetBasePositionAndOrientation(uid, pose.position.tolist(), [x, y, z, w])

    def _textured(self, mesh: TexturedMesh) -> int:
        """Add a visual body; Bullet takes textured meshes from OBJ files only, read while the files exist."""
        with tempfile.TemporaryDirectory() as folder:
            cv2.imwrite(f"{folder}/texture.png", mesh.texture[..., ::-1])
            Path(folder, "mesh.mtl").write_text("newmtl material\nmap_Kd texture.png\n", encoding="utf-8")
            Path(folder, "mesh.obj").write_text(_as_obj(mesh), encoding="utf-8")
            shape = self._bullet.createVisualShape(pybullet.GEOM_MESH, fileName=f"{folder}/mesh.obj")
            return self._bullet.createMultiBody(0, -1, shape, [0, 0, -100])


def _as_obj(mesh: TexturedMesh) -> str:
    lines = ["mtllib mesh.mtl", "usemtl material"]
    lines += [f"v {x:.7g} {y:.7g} {z:.7g}" for x, y, z in mesh.vertices.tolist()]
    lines += [f"vt {u:.7g} {v:.7g}" for u, v in mesh.uv.tolist()]
    lines += [f"vn {x:.5g} {y:.5g} {z:.5g}" for x, y, z in mesh.normals.tolist()]
    lines += [f"f {a}/{a}/{a} {b}/{b}/{b} {c}/{c}/{c}" for a, b, c in (mesh.faces + 1).tolist()]
    return "\n".join(lines) + "\n"


def _projection_matrix(camera: Camera) -> list[float]:
    """OpenGL projection of the pinhole intrinsics, column-major."""
    K, w, h = camera.intrinsics, camera.width, camera.height
    matrix = np.zeros((4, 4))
    matrix[0, 0], matrix[1, 1] = 2 * K[0, 0] / w, 2 * K[1, 1] / h
    matrix[0, 1] = -2 * K[0, 1] / w  # skew; y points up here
    matrix[0, 2], matrix[1, 2] = 1 - 2 * K[0, 2] / w, 2 * K[1, 2] / h - 1
    matrix[2, 2] = -(_FAR_M + _NEAR_M) / (_FAR_M - _NEAR_M)
    matrix[2, 3] = -2 * _FAR_M * _NEAR_M / (_FAR_M - _NEAR_M)
    matrix[3, 2] = -1
    return matrix.T.ravel().tolist()
