"""Rigid bodies on a table in PyBullet, the paper's simulator.

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
from pathlib import Path
from types import ModuleType
from typing import Any

import numpy as np
from jaxtyping import Float

from osfcore.geometry.poses import Pose
from osfcore.geometry.workspace import PUSHER_HEIGHT_M, PUSHER_RADIUS_M, TABLE_SIDE_M
from osfcore.world.physics import FLOOR_Z_M, GRAVITY_M_S2, REACH_M, TIME_STEP_S, BodyModel, Hull, Physics, reached


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

TABLE_FRICTION = 1.0
OBJECT_FRICTION = 0.5
PUSHER_FRICTION = 0.5
ROLLING_FRICTION_M = 0.003
SPINNING_FRICTION_M = 0.003
PUSHER_MASS_KG = 100.0  # so heavy that no object slows it; its pose is set exactly after each step anyway
COLLISION_MARGIN_M = 0.0002  # Bullet inflates convex hulls by it; larger ones make objects hover
_TABLE_THICKNESS_M = 0.1


class BulletClient:
    """PyBullet's functions, bound to a simulation of their own."""

    def __init__(self) -> None:
        self._id = pybullet.connect(pybullet.DIRECT)

    def __getattr__(self, name: str) -> Callable[..., Any]:
        """Bind a function, once: later look-ups find it among the attributes."""
        bound = functools.partial(getattr(pybullet, name), physicsClientId=self._id)
        setattr(self, name, bound)
        return bound


class BulletPhysics(Physics):
    """A simulation by PyBullet.

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
            path.write_text(_hulls_as_obj(model.hulls), encoding="utf-8")
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

        The pusher stops at the border of its reach, |x| and |y| of `PUSHERREACH_M`.
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
        """Let an object move from now on."""
        self._bullet.resetBaseVelocity(self._uids[name], linear.tolist(), angular.tolist())

    def distance(self, first: str, second: str | None, reach_m: float = REACH_M) -> float:
        """Return the gap between two objects, or an object and the pusher [m]; negative if they penetrate."""
        return self._gap(first, self._pusher if second is None else self._uids[second], reach_m)

    def table_distance(self, name: str) -> float:
        """Return the gap between an object and the table [m]; negative if it sinks in; 0.05 if larger."""
        return self._gap(name, self._table, REACH_M)

    def _gap(self, name: str, other: int, reach_m: float) -> float:
        points = self._bullet.getClosestPoints(self._uids[name], other, reach_m)
        return min((point[8] for point in points), default=reach_m)

    def separation(self, first: str, second: str) -> tuple[float, Float[np.ndarray, "3"]]:
        """Return the gap between two objects [m], 0.05 if larger, and the unit vector along which the first leaves."""
        points = self._bullet.getClosestPoints(self._uids[first], self._uids[second], REACH_M)
        nearest = min(points, key=lambda point: point[8], default=None)
        return (REACH_M, np.array([0.0, 0.0, 1.0])) if nearest is None else (nearest[8], np.array(nearest[7]))


def _hulls_as_obj(hulls: tuple[Hull, ...]) -> str:
    lines: list[str] = []
    offset = 1
    for number, (corners, triangles) in enumerate(hulls):
        lines.append(f"o part{number}")
        lines += [f"v {x:.9g} {y:.9g} {z:.9g}" for x, y, z in corners]
        lines += [f"f {a + offset} {b + offset} {c + offset}" for a, b, c in triangles]
        offset += len(corners)
    return "\n".join(lines) + "\n"
