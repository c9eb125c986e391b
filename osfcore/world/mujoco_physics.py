"""Rigid bodies on a table in MuJoCo, which runs under every Python.

Coulomb friction between object and table is 0.31: the median of what was measured of an aluminium triangle on
paperboard, where plywood has 0.34 (`tests.bench.push_friction`, logs of CMU). To the pusher it is 0.25, as in PyBullet.
The limit surface comes from the contact points: an object that stands on three or more of them has its torsional
friction by their lever arms. Rolling and spinning friction of a single point are lever arms [m], which no pushing data
tell: they are PyBullet's, so that cans and fruit come to rest within a second.

Contacts are springs with dampers in MuJoCo. These are so stiff that objects sink by some micrometres, and of one
stiffness at any depth: where it grows with the depth, as by default, a pushed box rattles more.
"""

# mujoco-core has no types of its compiled part.
# pyright: reportAttributeAccessIssue=false

from __future__ import annotations

from collections.abc import Mapping

import mujoco
import numpy as np
from jaxtyping import Float

from osfcore.geometry.poses import Pose, rotate
from osfcore.geometry.workspace import PUSHER_HEIGHT_M, PUSHER_RADIUS_M, TABLE_SIDE_M
from osfcore.world.physics import FLOOR_Z_M, GRAVITY_M_S2, REACH_M, TIME_STEP_S, BodyModel, Physics, reached

TABLE_FRICTION = 0.31
PUSHER_FRICTION = 0.25
ROLLING_FRICTION_M = 0.003
SPINNING_FRICTION_M = 0.003
PUSHER_MASS_KG = 100.0  # so heavy that no object slows it; its position is set exactly after each step anyway
_TABLE_THICKNESS_M = 0.1
_SUBSTEPS = 2  # with one, a pushed box rattles
_STIFF = {"solref": [2 * TIME_STEP_S, 1.0], "solimp": [0.99, 0.99, 0.001, 0.5, 2.0]}
_ALL_WAYS = 6  # friction along, about and across a contact's normal
_OBJECTS, _PUSHER = 1, 2  # bits of what collides


class MujocoPhysics(Physics):
    """A simulation by MuJoCo.

    The state has no memory of past contacts, so that a state that was put back goes on as it did.

    Args:
        models: the objects that take part, by name.
        friction_factor: on the friction of the objects.
        mass_factor: on their masses and moments of inertia.
    """

    def __init__(
        self, models: Mapping[str, BodyModel], *, friction_factor: float = 1.0, mass_factor: float = 1.0
    ) -> None:
        self._models = dict(models)
        spec = mujoco.MjSpec()
        spec.option.timestep = TIME_STEP_S / _SUBSTEPS
        spec.option.gravity = [0, 0, -GRAVITY_M_S2]
        spec.option.integrator = mujoco.mjtIntegrator.mjINT_IMPLICITFAST
        spec.option.cone = mujoco.mjtCone.mjCONE_ELLIPTIC
        spec.option.impratio = 10.0  # friction stiffer than the normal force: objects at rest do not creep
        _add_surroundings(spec, friction_factor * PUSHER_FRICTION)
        for name, model in self._models.items():
            _add_object(spec, name, model, friction_factor, mass_factor)
        self._model = spec.compile()
        self._data = mujoco.MjData(self._model)
        bodies = {name: self._model.body(name) for name in self._models}
        joints = {name: int(body.jntadr[0]) for name, body in bodies.items()}
        self._ids = {name: int(body.id) for name, body in bodies.items()}
        self._at = {name: slice(a := self._model.jnt_qposadr[joint], a + 7) for name, joint in joints.items()}
        self._moves = {name: slice(a := self._model.jnt_dofadr[joint], a + 6) for name, joint in joints.items()}
        self._geoms = {name: np.flatnonzero(self._model.geom_bodyid == i) for name, i in self._ids.items()}
        self._table_geom, self._pusher_geom = (np.array([self._model.geom(name).id]) for name in ("table", "pusher"))
        self.reset()

    def reset(self) -> None:
        """Start over from the state right after construction, with nothing on the table."""
        mujoco.mj_resetData(self._model, self._data)
        self._pusher_position = np.array([0, 0, 2.0])
        self._is_moved = True

    def close(self) -> None:
        """Free the simulation."""
        del self._data, self._model

    @property
    def pusher(self) -> Float[np.ndarray, "3"]:
        """Centre of the pusher [m]."""
        return self._pusher_position.copy()

    def pose(self, name: str) -> Pose:
        """Return `T_world_object`."""
        state = self._data.qpos[self._at[name]].copy()
        inertial = Pose(state[:3], state[3:] / np.linalg.norm(state[3:]))
        return inertial @ self._models[name].T_inertial_object

    def place(self, name: str, pose: Pose) -> None:
        """Put an object at rest at `T_world_object`."""
        inertial = pose @ self._models[name].T_object_inertial
        self._data.qpos[self._at[name]] = np.concatenate([inertial.position, inertial.quaternion])
        self._data.qvel[self._moves[name]] = 0
        self._forget()

    def place_pusher(self, position: Float[np.ndarray, "3"]) -> None:
        """Put the pusher upright at rest with its centre at `position` [m]."""
        self._pusher_position = np.array(position, float)
        self._forget()

    def _forget(self) -> None:
        """Drop the last forces, from which the solver would start, and the positions of shapes."""
        self._data.qacc_warmstart[:] = 0
        self._is_moved = True

    def step(self, velocity: Float[np.ndarray, "3"]) -> frozenset[str]:
        """Advance by `TIME_STEP_S` with the pusher at a velocity [m/s]; return the objects it touched."""
        start = self._pusher_position
        goal = reached(start, velocity * TIME_STEP_S)
        self._data.qpos[:3] = start
        touched = set[int]()
        for _ in range(_SUBSTEPS):
            self._data.qvel[:3] = (goal - start) / TIME_STEP_S
            mujoco.mj_step(self._model, self._data)
            pairs = self._data.contact.geom
            touched.update(self._model.geom_bodyid[pairs[np.any(pairs == self._pusher_geom, axis=1)]].ravel())
        self._pusher_position, self._is_moved = goal, True
        return frozenset(name for name, body in self._ids.items() if body in touched)

    def speed(self, name: str) -> tuple[float, float]:
        """Return linear [m/s] and angular [rad/s] speed of an object."""
        motion = self._data.qvel[self._moves[name]]
        return float(np.linalg.norm(motion[:3])), float(np.linalg.norm(motion[3:]))

    def set_velocity(self, name: str, linear: Float[np.ndarray, "3"], angular: Float[np.ndarray, "3"]) -> None:
        """Let an object move from now on."""
        w, x, y, z = self._data.qpos[self._at[name]][3:]
        turned = rotate(np.array([w, -x, -y, -z]), angular)  # MuJoCo turns bodies about their own axes
        self._data.qvel[self._moves[name]] = np.concatenate([linear, turned])

    def distance(self, first: str, second: str | None, reach_m: float = REACH_M) -> float:
        """Return the gap between two objects, or an object and the pusher [m]; negative if they penetrate."""
        return self._gap(first, self._pusher_geom if second is None else self._geoms[second], reach_m)[0]

    def table_distance(self, name: str) -> float:
        """Return the gap between an object and the table [m]; negative if it sinks in; 0.05 if larger."""
        return self._gap(name, self._table_geom, REACH_M)[0]

    def separation(self, first: str, second: str) -> tuple[float, Float[np.ndarray, "3"]]:
        """Return the gap between two objects [m], 0.05 if larger, and the unit vector along which the first leaves."""
        gap, ends = self._gap(first, self._geoms[second], REACH_M)
        return gap, np.array([0.0, 0.0, 1.0]) if ends is None or gap == 0 else (ends[:3] - ends[3:]) / gap

    def _gap(self, name: str, others: np.ndarray, reach_m: float) -> tuple[float, np.ndarray | None]:
        """Return the least gap to any of some shapes, and its two ends, on the object and on the other; None if far."""
        model, data = self._model, self._data
        if self._is_moved:
            data.qpos[:3] = self._pusher_position
            mujoco.mj_kinematics(model, data)
            self._is_moved = False
        own = self._geoms[name]
        apart = np.linalg.norm(data.geom_xpos[own, None] - data.geom_xpos[None, others], axis=-1)
        apart -= model.geom_rbound[own, None] + model.geom_rbound[None, others]
        least, found, ends = reach_m, None, np.zeros(6)
        for i, j in zip(*np.nonzero(apart < reach_m), strict=True):
            gap = mujoco.mj_geomDistance(model, data, own[i], others[j], reach_m, ends)
            if gap < least:
                least, found = gap, ends.copy()
        return least, found


def _add_surroundings(spec: mujoco.MjSpec, pusher_friction: float) -> None:
    """Add table, floor and pusher."""
    half = TABLE_SIDE_M / 2
    friction = [TABLE_FRICTION, SPINNING_FRICTION_M, ROLLING_FRICTION_M]
    shared = {"friction": friction, "condim": _ALL_WAYS, "contype": _OBJECTS, "conaffinity": _OBJECTS, **_STIFF}
    box, plane = mujoco.mjtGeom.mjGEOM_BOX, mujoco.mjtGeom.mjGEOM_PLANE
    size, down = [half, half, _TABLE_THICKNESS_M / 2], [0, 0, -_TABLE_THICKNESS_M / 2]
    spec.worldbody.add_geom(name="table", type=box, size=size, pos=down, **shared)
    spec.worldbody.add_geom(name="floor", type=plane, size=[0, 0, 1], pos=[0, 0, FLOOR_Z_M], **shared)
    upright = {"ipos": [0, 0, 0], "iquat": [1, 0, 0, 0], "inertia": [1, 1, 1], "explicitinertial": True}
    pusher = spec.worldbody.add_body(name="pusher", mass=PUSHER_MASS_KG, gravcomp=1, **upright)
    for axis in np.eye(3):
        pusher.add_joint(type=mujoco.mjtJoint.mjJNT_SLIDE, axis=axis)
    pusher.add_geom(
        name="pusher",
        type=mujoco.mjtGeom.mjGEOM_CYLINDER,
        size=[PUSHER_RADIUS_M, PUSHER_HEIGHT_M / 2, 0],
        priority=2,  # its friction counts, whatever it touches
        friction=[pusher_friction, SPINNING_FRICTION_M, ROLLING_FRICTION_M],
        contype=_PUSHER,
        conaffinity=0,
        condim=_ALL_WAYS,
        **_STIFF,
    )


def _add_object(spec: mujoco.MjSpec, name: str, model: BodyModel, friction_factor: float, mass_factor: float) -> None:
    """Add one object, out of everything's way until it is placed."""
    body = spec.worldbody.add_body(
        name=name,
        pos=[10.0 * len(spec.bodies), 0.0, 50.0],
        mass=mass_factor * model.mass_kg,
        inertia=mass_factor * model.moments,
        ipos=[0, 0, 0],
        iquat=[1, 0, 0, 0],
        explicitinertial=True,
    )
    body.add_freejoint()
    for number, (corners, _) in enumerate(model.hulls):
        mesh = spec.add_mesh(name=f"{name}/{number}", uservert=corners.astype(float).ravel())
        mesh.inertia = mujoco.mjtMeshInertia.mjMESH_INERTIA_CONVEX
        body.add_geom(
            type=mujoco.mjtGeom.mjGEOM_MESH,
            meshname=mesh.name,
            priority=1,
            friction=[friction_factor * TABLE_FRICTION, SPINNING_FRICTION_M, ROLLING_FRICTION_M],
            contype=_OBJECTS,
            conaffinity=_OBJECTS | _PUSHER,
            condim=_ALL_WAYS,
            **_STIFF,
        )
