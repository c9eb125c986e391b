"""What moves bodies on a table: poses in, contacts and poses out. `osfcore.world.simulators` has the engines."""

from __future__ import annotations

from abc import ABC, abstractmethod
from dataclasses import dataclass
from typing import TypeAlias

import numpy as np
from jaxtyping import Float, Int
from scipy.spatial import ConvexHull

from osfcore.geometry.poses import Pose, quaternion_from_matrix, rotate
from osfcore.geometry.workspace import PUSHER_REACH_M, STEP_S
from osfcore.objects.asset import ObjectAsset

TIME_STEP_S = 1 / 240
SUBSTEPS = round(STEP_S / TIME_STEP_S)
GRAVITY_M_S2 = 9.81
FLOOR_Z_M = -0.75  # where something lies that was pushed off the table
REACH_M = 0.05  # gaps are measured up to this

Hull: TypeAlias = tuple[Float[np.ndarray, "_ 3"], Int[np.ndarray, "_ 3"]]


@dataclass(frozen=True, eq=False, slots=True)
class BodyModel:
    """What physics needs of an object, made once by `body_model`.

    Attributes:
        mass_kg: mass [kg].
        T_object_inertial: centre of mass and principal axes in the object frame.
        T_inertial_object: its inverse.
        moments: principal moments [kg m^2].
        hulls: convex parts, each as corners [m] in the inertial frame and triangles.
    """

    mass_kg: float
    T_object_inertial: Pose
    T_inertial_object: Pose
    moments: Float[np.ndarray, "3"]
    hulls: tuple[Hull, ...]


def body_model(asset: ObjectAsset) -> BodyModel:
    """Compute mass properties and collision shape of an object."""
    T_object_inertial, moments = mass_properties(asset.parts, asset.info.mass_kg)
    T_inertial_object = T_object_inertial.inverse()
    parts = [T_inertial_object.apply(part) for part in asset.parts]
    hulls = tuple((part, ConvexHull(part).simplices) for part in parts)
    return BodyModel(asset.info.mass_kg, T_object_inertial, T_inertial_object, moments, hulls)


class Physics(ABC):
    """A simulation of objects, pusher and table. Deterministic: the same calls give the same bits."""

    @abstractmethod
    def reset(self) -> None:
        """Start over from the state right after construction, with nothing on the table."""

    @abstractmethod
    def close(self) -> None:
        """Free the simulation."""

    @property
    @abstractmethod
    def pusher(self) -> Float[np.ndarray, "3"]:
        """Centre of the pusher [m]."""

    @abstractmethod
    def pose(self, name: str) -> Pose:
        """Return `T_world_object`."""

    @abstractmethod
    def place(self, name: str, pose: Pose) -> None:
        """Put an object at rest at `T_world_object`."""

    @abstractmethod
    def place_pusher(self, position: Float[np.ndarray, "3"]) -> None:
        """Put the pusher upright at rest with its centre at `position` [m]."""

    @abstractmethod
    def step(self, velocity: Float[np.ndarray, "3"]) -> frozenset[str]:
        """Advance by `TIME_STEP_S` with the pusher at a velocity [m/s]; return the objects it touched.

        The pusher stops at the border of its reach, |x| and |y| of `PUSHER_REACH_M`.
        """

    @abstractmethod
    def speed(self, name: str) -> tuple[float, float]:
        """Return linear [m/s] and angular [rad/s] speed of an object."""

    @abstractmethod
    def set_velocity(self, name: str, linear: Float[np.ndarray, "3"], angular: Float[np.ndarray, "3"]) -> None:
        """Let an object move from now on.

        Args:
            name: which object.
            linear: velocity of its centre of mass in the world [m/s].
            angular: angular velocity in the world [rad/s].
        """

    @abstractmethod
    def distance(self, first: str, second: str | None, reach_m: float = REACH_M) -> float:
        """Return the gap between two objects, or an object and the pusher [m]; negative if they penetrate.

        Args:
            first: an object.
            second: another object, or None for the pusher.
            reach_m: returned for gaps that are larger.
        """

    @abstractmethod
    def table_distance(self, name: str) -> float:
        """Return the gap between an object and the table [m]; negative if it sinks in; 0.05 if larger."""

    @abstractmethod
    def separation(self, first: str, second: str) -> tuple[float, Float[np.ndarray, "3"]]:
        """Return the gap between two objects [m], 0.05 if larger, and the unit vector along which the first leaves."""


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
