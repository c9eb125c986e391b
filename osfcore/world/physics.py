"""Rigid bodies on a table in PyBullet: one client per simulation, poses in, contacts and poses out.

PyBullet's quaternions are (x, y, z, w): they are converted here.

Friction: 0.5 on objects and 1.0 on the table are Bullet's own values for a body and for its plane, in force where a
setup names none, as the paper's does; Bullet multiplies them, so 0.5 acts between object and table and 0.25 between
object and pusher. Rolling friction is a lever arm [m] chosen so that cans and fruit come to rest within a second.
"""

from __future__ import annotations

import os
import tempfile
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from types import ModuleType

import numpy as np
from jaxtyping import Float
from scipy.spatial import ConvexHull

from osfcore.geometry.poses import Pose, quaternion_from_matrix, rotate
from osfcore.geometry.workspace import PUSHER_HEIGHT_M, PUSHER_RADIUS_M, PUSHER_REACH_M, STEP_S, TABLE_SIDE_M
from osfcore.objects.asset import ObjectAsset

# PyBullet, imported without the line about its build that it writes to stderr each time.


@contextmanager
def _nothing_said() -> Iterator[None]:
    """Let the descriptor of stderr lead nowhere, for C code writes to it."""
    try:
        kept = os.dup(2)
    except OSError:  # a service may have been started without one
        yield
        return
    nowhere = os.open(os.devnull, os.O_WRONLY)
    try:
        os.dup2(nowhere, 2)
        yield
    finally:
        os.dup2(kept, 2)
        os.close(kept)
        os.close(nowhere)


def _imported() -> ModuleType:
    with _nothing_said():
        import pybullet
    return pybullet


pybullet = _imported()


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


@dataclass(frozen=True, eq=False, slots=True)
class BodyModel:
    """What physics needs of an object, made once: `body_model`.

    Attributes:
        mass_kg: mass [kg].
        T_object_inertial: centre of mass and principal axes in the object frame.
        moments: principal moments [kg m^2].
        hulls: convex parts as a Wavefront OBJ, one group each, around the centre of mass.
    """

    mass_kg: float
    T_object_inertial: Pose
    moments: Float[np.ndarray, "3"]
    hulls: str


def body_model(asset: ObjectAsset) -> BodyModel:
    """Mass properties and collision shape of an object."""
    T_object_inertial, moments = mass_properties(asset.parts, asset.info.mass_kg)
    T_inertial_object = T_object_inertial.inverse()
    hulls = _hulls_as_obj([T_inertial_object.apply(part) for part in asset.parts])
    return BodyModel(asset.info.mass_kg, T_object_inertial, moments, hulls)


@dataclass(frozen=True, eq=False, slots=True)
class _Body:
    """A body in the simulation and where its centre of mass sits in the object frame."""

    uid: int
    T_object_inertial: Pose
    T_inertial_object: Pose


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
        self._client = pybullet.connect(pybullet.DIRECT)
        self._models = dict(models)
        self._friction = friction_factor * OBJECT_FRICTION
        self._mass_factor = mass_factor
        self._build()

    def _build(self) -> None:
        c = self._client
        pybullet.resetSimulation(physicsClientId=c)
        pybullet.setPhysicsEngineParameter(
            fixedTimeStep=TIME_STEP_S,
            numSolverIterations=50,
            deterministicOverlappingPairs=1,
            enableFileCaching=0,
            physicsClientId=c,
        )
        pybullet.setGravity(0, 0, -GRAVITY_M_S2, physicsClientId=c)
        half = [TABLE_SIDE_M / 2, TABLE_SIDE_M / 2, _TABLE_THICKNESS_M / 2]
        table_shape = pybullet.createCollisionShape(pybullet.GEOM_BOX, halfExtents=half, physicsClientId=c)
        self._table = pybullet.createMultiBody(
            0, table_shape, basePosition=[0, 0, -_TABLE_THICKNESS_M / 2], physicsClientId=c
        )
        self._dynamics(self._table, TABLE_FRICTION)
        floor_shape = pybullet.createCollisionShape(pybullet.GEOM_PLANE, physicsClientId=c)
        floor = pybullet.createMultiBody(0, floor_shape, basePosition=[0, 0, FLOOR_Z_M], physicsClientId=c)
        self._dynamics(floor, TABLE_FRICTION)
        pusher_shape = pybullet.createCollisionShape(
            pybullet.GEOM_CYLINDER, radius=PUSHER_RADIUS_M, height=PUSHER_HEIGHT_M, physicsClientId=c
        )
        self._pusher = pybullet.createMultiBody(
            PUSHER_MASS_KG, pusher_shape, basePosition=[0, 0, 2.0], physicsClientId=c
        )
        self._dynamics(self._pusher, PUSHER_FRICTION)
        pybullet.setCollisionFilterPair(self._pusher, self._table, -1, -1, 0, physicsClientId=c)
        self._pusher_position = np.array([0, 0, 2.0])
        self._bodies: dict[str, _Body] = {}
        for name, model in self._models.items():
            self._bodies[name] = self._add(model)

    def _dynamics(self, uid: int, friction: float) -> None:
        pybullet.changeDynamics(
            uid,
            -1,
            lateralFriction=friction,
            rollingFriction=ROLLING_FRICTION_M,
            spinningFriction=SPINNING_FRICTION_M,
            linearDamping=0,
            angularDamping=0,
            collisionMargin=COLLISION_MARGIN_M,
            physicsClientId=self._client,
        )

    def _add(self, model: BodyModel) -> _Body:
        """One object, out of everything's way until it is placed."""
        with tempfile.TemporaryDirectory() as folder:
            path = Path(folder) / "parts.obj"  # Bullet makes a compound of hulls from the groups of an OBJ file
            path.write_text(model.hulls)
            shape = pybullet.createCollisionShape(pybullet.GEOM_MESH, fileName=str(path), physicsClientId=self._client)
        # A visual shape of its own keeps Bullet from reading the file again for one.
        visual = pybullet.createVisualShape(pybullet.GEOM_SPHERE, radius=0.001, physicsClientId=self._client)
        away = [10.0 * (1 + len(self._bodies)), 0.0, 50.0]
        mass_kg, moments = self._mass_factor * model.mass_kg, self._mass_factor * model.moments
        uid = pybullet.createMultiBody(mass_kg, shape, visual, away, physicsClientId=self._client)
        self._dynamics(uid, self._friction)
        pybullet.changeDynamics(uid, -1, localInertiaDiagonal=moments.tolist(), physicsClientId=self._client)
        return _Body(uid, model.T_object_inertial, model.T_object_inertial.inverse())

    def reset(self) -> None:
        """Start over from the state right after construction, with nothing on the table."""
        self._build()

    def close(self) -> None:
        """Free the simulation."""
        if self._client >= 0:
            pybullet.disconnect(physicsClientId=self._client)
            self._client = -1

    @property
    def pusher(self) -> Float[np.ndarray, "3"]:
        """Centre of the pusher [m]."""
        return self._pusher_position.copy()

    def pose(self, name: str) -> Pose:
        """`T_world_object`."""
        body = self._bodies[name]
        position, xyzw = pybullet.getBasePositionAndOrientation(body.uid, physicsClientId=self._client)
        return Pose(np.array(position), np.array([xyzw[3], *xyzw[:3]])) @ body.T_inertial_object

    def place(self, name: str, pose: Pose) -> None:
        """Put an object at rest at `T_world_object`."""
        body = self._bodies[name]
        inertial = pose @ body.T_object_inertial
        w, x, y, z = inertial.quaternion
        pybullet.resetBasePositionAndOrientation(
            body.uid, inertial.position.tolist(), [x, y, z, w], physicsClientId=self._client
        )
        pybullet.resetBaseVelocity(body.uid, [0, 0, 0], [0, 0, 0], physicsClientId=self._client)

    def place_pusher(self, position: Float[np.ndarray, "3"]) -> None:
        """Put the pusher upright at rest with its centre at `position` [m]."""
        self._pusher_position = np.array(position, float)
        self._hold_pusher(np.zeros(3))

    def _hold_pusher(self, velocity: np.ndarray) -> None:
        pybullet.resetBasePositionAndOrientation(
            self._pusher, self._pusher_position.tolist(), [0, 0, 0, 1], physicsClientId=self._client
        )
        pybullet.resetBaseVelocity(self._pusher, velocity.tolist(), [0, 0, 0], physicsClientId=self._client)

    def step(self, velocity: Float[np.ndarray, "3"]) -> frozenset[str]:
        """Advance by `TIME_STEP_S` with the pusher at a velocity [m/s]; return the objects it touched.

        The pusher stops at the border of its reach, |x| and |y| of `PUSHER_REACH_M`.
        """
        start = self._pusher_position
        goal = start + velocity * TIME_STEP_S
        reach = np.maximum(PUSHER_REACH_M, np.abs(start[:2]))
        goal[:2] = np.clip(goal[:2], -reach, reach)
        self._hold_pusher((goal - start) / TIME_STEP_S + [0, 0, GRAVITY_M_S2 * TIME_STEP_S])
        pybullet.stepSimulation(physicsClientId=self._client)
        self._pusher_position = goal
        self._hold_pusher(np.zeros(3))
        return self._touched()

    def _touched(self) -> frozenset[str]:
        contacts = pybullet.getContactPoints(bodyA=self._pusher, physicsClientId=self._client)
        touched = {contact[2] for contact in contacts}
        return frozenset(name for name, body in self._bodies.items() if body.uid in touched)

    def speed(self, name: str) -> tuple[float, float]:
        """Linear [m/s] and angular [rad/s] speed of an object."""
        linear, angular = pybullet.getBaseVelocity(self._bodies[name].uid, physicsClientId=self._client)
        return float(np.linalg.norm(linear)), float(np.linalg.norm(angular))

    def set_velocity(
        self, name: str, linear: Float[np.ndarray, "3"], angular: Float[np.ndarray, "3"] | None = None
    ) -> None:
        """Let an object move from now on.

        Args:
            name: which object.
            linear: velocity of its centre of mass in the world [m/s].
            angular: angular velocity in the world [rad/s]; 0 if None.
        """
        turning = [0.0, 0.0, 0.0] if angular is None else angular.tolist()
        pybullet.resetBaseVelocity(self._bodies[name].uid, linear.tolist(), turning, physicsClientId=self._client)

    def distance(self, first: str, second: str | None, reach_m: float = 0.05) -> float:
        """Gap between two objects, or an object and the pusher [m]; negative if they penetrate.

        Args:
            first: an object.
            second: another object, or None for the pusher.
            reach_m: returned for gaps that are larger.
        """
        other = self._pusher if second is None else self._bodies[second].uid
        return self._gap(self._bodies[first].uid, other, reach_m)

    def separation(self, first: str, second: str) -> tuple[float, Float[np.ndarray, "3"]]:
        """Gap between two objects [m], 0.05 if larger, and the unit vector along which the first one leaves."""
        ids = self._bodies[first].uid, self._bodies[second].uid
        points = pybullet.getClosestPoints(*ids, 0.05, physicsClientId=self._client)
        nearest = min(points, key=lambda point: point[8], default=None)
        return (0.05, np.array([0.0, 0.0, 1.0])) if nearest is None else (nearest[8], np.array(nearest[7]))

    def table_distance(self, name: str) -> float:
        """Gap between an object and the table [m]; negative if it sinks in; 0.05 if larger."""
        return self._gap(self._bodies[name].uid, self._table, 0.05)

    def _gap(self, first: int, second: int, reach_m: float) -> float:
        points = pybullet.getClosestPoints(first, second, reach_m, physicsClientId=self._client)
        return min((point[8] for point in points), default=reach_m)


def mass_properties(parts: tuple[Float[np.ndarray, "_ 3"], ...], mass_kg: float) -> tuple[Pose, Float[np.ndarray, "3"]]:
    """Centre of mass with principal axes, and principal moments [kg m^2], of hulls of one uniform density.

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
    """Height of an object's lowest point relative to its frame's origin, when turned so [m]."""
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
