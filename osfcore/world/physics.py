"""Rigid bodies on a table in PyBullet: one client per simulation, poses in, contacts and poses out.

PyBullet's quaternions are (x, y, z, w): they are converted here.

Friction: 0.5 on objects and 1.0 on the table are Bullet's own values for a body and for its plane, in force where a
setup names none, as the paper's does; Bullet multiplies them, so 0.5 acts between object and table and 0.25 between
object and pusher. Rolling friction is a lever arm [m] chosen so that cans and fruit come to rest within a second.
"""

from __future__ import annotations

import functools
import importlib
import os
import tempfile
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from pathlib import Path
from types import ModuleType
from typing import Any

import numpy as np
from jaxtyping import Float
from scipy.spatial import ConvexHull

from osfcore.geometry.poses import Pose, quaternion_from_matrix, rotate
from osfcore.geometry.workspace import PUSHER_HEIGHT_M, PUSHER_RADIUS_M, PUSHER_REACH_M, STEP_S, TABLE_SIDE_M
from osfcore.objects.asset import ObjectAsset


def _import_quietly() -> ModuleType:
    """Import PyBullet without the line about its build, which its C code writes to stderr."""
    try:
        stderr = os.dup(2)
    except OSError:  # a service may have been started without one
        return importlib.import_module("pybullet")
    nowhere = os.open(os.devnull, os.O_WRONLY)
    try:
        os.dup2(nowhere, 2)
        return importlib.import_module("pybullet")
    finally:
        os.dup2(stderr, 2)
        os.close(stderr)
        os.close(nowhere)


pybullet = _import_quietly()

TIME_STEP_S = 1 / 240
SUBSTEPS = round(STEP_S / TIME_STEP_S)
GRAVITY_M_S2 = 9.81
TABLE_FRICTION = 1.0
OBJECT_FRICTION = 0.5
PUSHER_FRICTION = 0.5
ROLLING_FRICTION_M = 0.003
SPINNING_FRICTION_M = 0.003
PUSHER_MASS_KG = 100.0  # so heavy that no object slows it; its pose is set exactly after each step anyway
COLLISION_MARGIN_M = 0.0002  # Bullet inflates convex hulls by it; larger ones make objects hover
FLOOR_Z_M = -0.75  # where something lies that was pushed off the table
_TABLE_THICKNESS_M = 0.1
_REACH_M = 0.05  # gaps are measured up to this


class BulletClient:
    """PyBullet's functions, bound to a simulation of their own."""

    def __init__(self) -> None:
        self._id = pybullet.connect(pybullet.DIRECT)

    def __getattr__(self, name: str) -> Callable[..., Any]:
        """Bind a function, once: later look-ups find it among the attributes."""
        bound = functools.partial(getattr(pybullet, name), physicsClientId=self._id)
        setattr(self, name, bound)
        return bound


@dataclass(frozen=True, eq=False, slots=True)
class BodyModel:
    """What physics needs of an object, made once by `body_model`.

    Attributes:
        mass_kg: mass [kg].
        T_object_inertial: centre of mass and principal axes in the object frame.
        T_inertial_object: its inverse.
        moments: principal moments [kg m^2].
        hulls: convex parts as a Wavefront OBJ, one group each, around the centre of mass.
    """

    mass_kg: float
    T_object_inertial: Pose
    T_inertial_object: Pose
    moments: Float[np.ndarray, "3"]
    hulls: str


def body_model(asset: ObjectAsset) -> BodyModel:
    """Compute mass properties and collision shape of an object."""
    T_object_inertial, moments = mass_properties(asset.parts, asset.info.mass_kg)
    T_inertial_object = T_object_inertial.inverse()
    hulls = _hulls_as_obj([T_inertial_object.apply(part) for part in asset.parts])
    return BodyModel(asset.info.mass_kg, T_object_inertial, T_inertial_object, moments, hulls)


class Physics:
    """A simulation of objects, pusher and table. Deterministic: the same calls give the same bits.

    Args:
        models: the objects that take part, by name.
        friction_factor: on the friction of the objects.
        mass_factor: on their masses and moments of inertia.
    """

    def __init__(
        self, models: Mapping[str, BodyModel], *, friction_factor: float = 1.0, mass_factor: float = 1.0
    ) -> None:
        self._bullet = BulletClient()
        self._models = dict(models)
        self._friction = friction_factor * OBJECT_FRICTION
        self._mass_factor = mass_factor
        self.reset()

    def reset(self) -> None:
        """Start over from the state right after construction, with nothing on the table."""
        bullet = self._bullet
        bullet.resetSimulation()
        bullet.setPhysicsEngineParameter(
            fixedTimeStep=TIME_STEP_S, numSolverIterations=50, deterministicOverlappingPairs=1, enableFileCaching=0
        )
        bullet.setGravity(0, 0, -GRAVITY_M_S2)
        half = [TABLE_SIDE_M / 2, TABLE_SIDE_M / 2, _TABLE_THICKNESS_M / 2]
        table = bullet.createCollisionShape(pybullet.GEOM_BOX, halfExtents=half)
        self._table = bullet.createMultiBody(0, table, basePosition=[0, 0, -_TABLE_THICKNESS_M / 2])
        self._set_contacts(self._table, TABLE_FRICTION)
        plane = bullet.createCollisionShape(pybullet.GEOM_PLANE)
        self._set_contacts(bullet.createMultiBody(0, plane, basePosition=[0, 0, FLOOR_Z_M]), TABLE_FRICTION)
        self._pusher_position = np.array([0, 0, 2.0])
        cylinder = bullet.createCollisionShape(pybullet.GEOM_CYLINDER, radius=PUSHER_RADIUS_M, height=PUSHER_HEIGHT_M)
        self._pusher = bullet.createMultiBody(PUSHER_MASS_KG, cylinder, basePosition=[0, 0, 2.0])
        self._set_contacts(self._pusher, PUSHER_FRICTION)
        bullet.setCollisionFilterPair(self._pusher, self._table, -1, -1, 0)
        self._uids: dict[str, int] = {}
        for name, model in self._models.items():
            self._uids[name] = self._add(model)

    def _set_contacts(self, uid: int, friction: float) -> None:
        turning = {"rollingFriction": ROLLING_FRICTION_M, "spinningFriction": SPINNING_FRICTION_M}
        damping = {"linearDamping": 0, "angularDamping": 0}
        margin = COLLISION_MARGIN_M
        self._bullet.changeDynamics(uid, -1, lateralFriction=friction, collisionMargin=margin, **turning, **damping)

    def _add(self, model: BodyModel) -> int:
        """Add one object, out of everything's way until it is placed; return its Bullet id."""
        with tempfile.TemporaryDirectory() as folder:
            path = Path(folder) / "parts.obj"  # Bullet makes a compound of hulls from the groups of an OBJ file
            path.write_text(model.hulls)
            shape = self._bullet.createCollisionShape(pybullet.GEOM_MESH, fileName=str(path))
        # A visual shape of its own keeps Bullet from reading the file again for one.
        visual = self._bullet.createVisualShape(pybullet.GEOM_SPHERE, radius=0.001)
        away = [10.0 * (1 + len(self._uids)), 0.0, 50.0]
        uid = self._bullet.createMultiBody(self._mass_factor * model.mass_kg, shape, visual, away)
        self._set_contacts(uid, self._friction)
        self._bullet.changeDynamics(uid, -1, localInertiaDiagonal=(self._mass_factor * model.moments).tolist())
        return uid

    def close(self) -> None:
        """Free the simulation."""
        self._bullet.disconnect()

    @property
    def pusher(self) -> Float[np.ndarray, "3"]:
        """Centre of the pusher [m]."""
        return self._pusher_position.copy()

    def pose(self, name: str) -> Pose:
        """Return `T_world_object`."""
        position, (x, y, z, w) = self._bullet.getBasePositionAndOrientation(self._uids[name])
        return Pose(np.array(position), np.array([w, x, y, z])) @ self._models[name].T_inertial_object

    def place(self, name: str, pose: Pose) -> None:
        """Put an object at rest at `T_world_object`."""
        inertial = pose @ self._models[name].T_object_inertial
        w, x, y, z = inertial.quaternion
        self._bullet.resetBasePositionAndOrientation(self._uids[name], inertial.position.tolist(), [x, y, z, w])
        self._bullet.resetBaseVelocity(self._uids[name], [0, 0, 0], [0, 0, 0])

    def place_pusher(self, position: Float[np.ndarray, "3"]) -> None:
        """Put the pusher upright at rest with its centre at `position` [m]."""
        self._pusher_position = np.array(position, float)
        self._hold_pusher(np.zeros(3))

    def _hold_pusher(self, velocity: np.ndarray) -> None:
        self._bullet.resetBasePositionAndOrientation(self._pusher, self._pusher_position.tolist(), [0, 0, 0, 1])
        self._bullet.resetBaseVelocity(self._pusher, velocity.tolist(), [0, 0, 0])

    def step(self, velocity: Float[np.ndarray, "3"]) -> frozenset[str]:
        """Advance by `TIME_STEP_S` with the pusher at a velocity [m/s]; return the objects it touched.

        The pusher stops at the border of its reach, |x| and |y| of `PUSHER_REACH_M`.
        """
        start = self._pusher_position
        goal = reached(start, velocity * TIME_STEP_S)
        self._hold_pusher((goal - start) / TIME_STEP_S + [0, 0, GRAVITY_M_S2 * TIME_STEP_S])
        self._bullet.stepSimulation()
        self._pusher_position = goal
        self._hold_pusher(np.zeros(3))
        touched = {contact[2] for contact in self._bullet.getContactPoints(bodyA=self._pusher)}
        return frozenset(name for name, uid in self._uids.items() if uid in touched)

    def speed(self, name: str) -> tuple[float, float]:
        """Return linear [m/s] and angular [rad/s] speed of an object."""
        linear, angular = self._bullet.getBaseVelocity(self._uids[name])
        return float(np.linalg.norm(linear)), float(np.linalg.norm(angular))

    def set_velocity(self, name: str, linear: Float[np.ndarray, "3"], angular: Float[np.ndarray, "3"]) -> None:
        """Let an object move from now on.

        Args:
            name: which object.
            linear: velocity of its centre of mass in the world [m/s].
            angular: angular velocity in the world [rad/s].
        """
        self._bullet.resetBaseVelocity(self._uids[name], linear.tolist(), angular.tolist())

    def distance(self, first: str, second: str | None, reach_m: float = _REACH_M) -> float:
        """Return the gap between two objects, or an object and the pusher [m]; negative if they penetrate.

        Args:
            first: an object.
            second: another object, or None for the pusher.
            reach_m: returned for gaps that are larger.
        """
        return self._gap(first, self._pusher if second is None else self._uids[second], reach_m)

    def table_distance(self, name: str) -> float:
        """Return the gap between an object and the table [m]; negative if it sinks in; 0.05 if larger."""
        return self._gap(name, self._table, _REACH_M)

    def _gap(self, name: str, other: int, reach_m: float) -> float:
        points = self._bullet.getClosestPoints(self._uids[name], other, reach_m)
        return min((point[8] for point in points), default=reach_m)

    def separation(self, first: str, second: str) -> tuple[float, Float[np.ndarray, "3"]]:
        """Return the gap between two objects [m], 0.05 if larger, and the unit vector along which the first leaves."""
        points = self._bullet.getClosestPoints(self._uids[first], self._uids[second], _REACH_M)
        nearest = min(points, key=lambda point: point[8], default=None)
        return (_REACH_M, np.array([0.0, 0.0, 1.0])) if nearest is None else (nearest[8], np.array(nearest[7]))


def reached(start: Float[np.ndarray, "3"], way: Float[np.ndarray, "3"]) -> Float[np.ndarray, "3"]:
    """Return where the pusher is after a way from a start [m]: it stops at the border of its reach."""
    reach = np.maximum(PUSHER_REACH_M, np.abs(start[:2]))
    goal = start + way
    goal[:2] = np.clip(goal[:2], -reach, reach)
    return goal


def mass_properties(parts: tuple[Float[np.ndarray, "_ 3"], ...], mass_kg: float) -> tuple[Pose, Float[np.ndarray, "3"]]:
    """Return centre of mass with principal axes, and principal moments [kg m^2], of hulls of one uniform density.

    Parts are summed as if they did not overlap.
    """
    # Each part is cut into tetrahedra from an inner point to the triangles of its hull, corners p0 (inner) to p3.
    tetrahedra = []
    for part in parts:
        hull = ConvexHull(part)
        corners = part[hull.simplices].astype(float)
        inner = np.broadcast_to(part[hull.vertices].mean(axis=0, dtype=float), (len(corners), 1, 3))
        tetrahedra.append(np.concatenate([inner, corners], axis=1))
    points = np.concatenate(tetrahedra)  # (S, 4, 3)
    volumes = np.abs(np.linalg.det(points[:, 1:] - points[:, :1])) / 6
    sums = points.sum(axis=1)
    centre = volumes @ sums / 4 / volumes.sum()
    # Second moments of a tetrahedron: V / 20 (s s^T + sum_i p_i p_i^T), with s the sum of its corners.
    second = np.einsum("s,si,sj->ij", volumes, sums, sums) + np.einsum("s,ski,skj->ij", volumes, points, points)
    covariance = second / 20 / volumes.sum() - np.outer(centre, centre)
    moments, axes = np.linalg.eigh(mass_kg * (np.trace(covariance) * np.eye(3) - covariance))
    if np.linalg.det(axes) < 0:
        axes[:, 0] *= -1
    return Pose(centre, quaternion_from_matrix(axes)), moments


def lowest_point(asset: ObjectAsset, quaternion: Float[np.ndarray, "4"]) -> float:
    """Return the height of an object's lowest point above its frame's origin when turned by a quaternion [m]."""
    return min(float(rotate(quaternion, part)[:, 2].min()) for part in asset.parts)


def _hulls_as_obj(parts: list[np.ndarray]) -> str:
    lines: list[str] = []
    offset = 1
    for number, part in enumerate(parts):
        lines.append(f"o part{number}")
        lines += [f"v {x:.9g} {y:.9g} {z:.9g}" for x, y, z in part]
        lines += [f"f {a + offset} {b + offset} {c + offset}" for a, b, c in ConvexHull(part).simplices]
        offset += len(part)
    return "\n".join(lines) + "\n"
