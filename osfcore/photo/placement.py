"""Cameras of several photographs of one table, from the objects that they share.

Each photograph alone gives some poses of each of its objects in its camera's frame, the best first. A photograph is
placed among those before it in two steps.

1. Consensus. Object i in pose A in the world and in pose B before the camera places it at T = A S B^-1, with S one of
   the motions that change hardly anything but its print. The T is sought at which most objects agree,

       c(T) = sum_i min(9, min_{A, B, S} |x_A - x_TBS|^2 / (4 cm)^2 + angle^2 / (12 deg)^2 + p_A + p_B + p_S),

   where p grows with how much worse than the best a pose explains its photograph.
2. Bundle adjustment. Where a photograph alone shows an object's points is right to a few pixels even if its distance
   is not. Cameras, poses, and an unknown focal length minimise the distances of points from there, with a robust loss,
   over all photographs. Objects' sizes give the scale.
"""

from __future__ import annotations

import itertools
from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np
from jaxtyping import Float
from scipy.optimize import least_squares

from osfcore.geometry.poses import Pose, quaternion_exp, quaternion_multiply, rotate, rotation_angle

_POSITION_STD_M, _ROTATION_STD_RAD = 0.04, np.deg2rad(12.0)
_MOST_COST = 9.0  # of an object in a consensus
_LOSS_STD = 0.1  # of what a pose explains worse than the best
_TURNED_COST = 1.0  # of a pose whose print is elsewhere
_TRIED, _APART_DEG, _APART_M = 4, 8.0, 0.08  # placements that are adjusted, and how they differ
_POINT_STD = 0.02  # of a point in a photograph [radii of the object]
_FARTHEST = 4.0  # deviations of a point, in the mean over an object, with which it still agrees
_FOCAL_STD = 0.3  # of the logarithm of an assumed focal length
_POINT_STD_TURNED = 0.08  # the same, turned by one of a few symmetries of a round object
_EVALUATIONS, _TOLERANCE, _STEP = 30, 1e-4, 1e-7
_NEAREST_M = 1e-3
_CORNERS = np.array(list(itertools.product((-1, 1), repeat=3))) / np.sqrt(3)


@dataclass(frozen=True, eq=False, slots=True)
class Sight:
    """What one photograph alone shows of an object.

    Attributes:
        poses: K poses in the camera's frame, the best first.
        losses: how badly each explains the photograph.
    """

    poses: Pose
    losses: Float[np.ndarray, "K"]


@dataclass(frozen=True, eq=False, slots=True)
class Placement:
    """Cameras and objects in one world.

    Attributes:
        cameras: `T_world_camera` of each photograph; None where it does not fit the others.
        poses: `T_world_object` of the objects on which photographs agree, by name.
        agreeing: numbers of photographs, and names of objects that these show there.
        focal_factor: of the focal lengths that were assumed.
    """

    cameras: tuple[Pose | None, ...]
    poses: Mapping[str, Pose]
    agreeing: frozenset[tuple[int, str]] = frozenset()
    focal_factor: float = 1.0


@dataclass(frozen=True, eq=False, slots=True)
class Shape:
    """What placement needs of an object.

    Attributes:
        radius: of its points [m].
        symmetries: motions that change hardly anything but its print, the identity first.
    """

    radius: float
    symmetries: Pose


@dataclass(frozen=True, eq=False, slots=True)
class _Match:
    """An object of a photograph, in the pose in which it agrees with the others.

    Attributes:
        photo: number of the photograph.
        name: of the object.
        seen: pose in the camera's frame, perhaps turned by one of its symmetries.
        is_turned: whether it is.
    """

    photo: int
    name: str
    seen: Pose
    is_turned: bool


def place_cameras(
    sights: Sequence[Mapping[str, Sight]],
    shapes: Mapping[str, Shape],
    known: Sequence[Pose | None] = (),
    *,
    focal_known: bool = True,
) -> Placement:
    """Find where photographs of one table were taken.

    Args:
        sights: what each photograph alone shows, by name of the object.
        shapes: of the objects.
        known: poses of cameras; None where they are not known. If there is none, the world is the frame of the first
            camera that is found.
        focal_known: whether focal lengths are more than guesses; else all are taken to be wrong by the same factor.

    Returns:
        Cameras and poses. A photograph is left out if fewer than two objects agree, or none where it shares but one.
    """
    cameras: list[Pose | None] = list(known) or [None] * len(sights)
    fixed = frozenset(k for k, camera in enumerate(cameras) if camera is not None)
    problem = _Problem(sights, shapes, fixed, focal_known)
    if not fixed:
        cameras[problem.anchor()] = Pose.identity()
    best, left = Placement(tuple(cameras), {}), [k for k, camera in enumerate(cameras) if camera is None]
    while left:
        placed = {name for k, camera in enumerate(best.cameras) if camera is not None for name in sights[k]}
        for photo in sorted(left, key=lambda k: -len(sights[k].keys() & placed)):
            tried = [problem.adjusted(cameras) for cameras in problem.candidates(best, photo)]
            placement = min(tried, key=lambda each: each[0])[1] if tried else best
            if sum(k == photo for k, _ in placement.agreeing) >= min(2, max(1, len(sights[photo].keys() & placed))):
                best = placement
                left.remove(photo)
                break
        else:
            break
    if fixed:
        return best
    first = next(camera for camera in best.cameras if camera is not None).inverse()
    moved = tuple(None if camera is None else first @ camera for camera in best.cameras)
    return replace(best, cameras=moved, poses={name: first @ pose for name, pose in best.poses.items()})


class _Problem:
    """What is known of all photographs, with the search for a camera and the adjustment of all."""

    def __init__(
        self,
        sights: Sequence[Mapping[str, Sight]],
        shapes: Mapping[str, Shape],
        fixed: frozenset[int],
        focal_known: bool,
    ) -> None:
        self._sights, self._shapes, self._fixed, self._focal_known = sights, shapes, fixed, focal_known
        self._turned = [{name: _turned(its, shapes[name]) for name, its in sight.items()} for sight in sights]

    def anchor(self) -> int:
        """Return the first of the two photographs whose objects agree best."""
        best = 0.0, 0
        for one, other in itertools.combinations(range(len(self._sights)), 2):
            alone: list[Pose | None] = [None] * len(self._sights)
            alone[one] = Pose.identity()
            shared = len(self._sights[one].keys() & self._sights[other].keys())
            costs = self._places(Placement(tuple(alone), {}), other)[1]
            best = max(best, (_MOST_COST * shared - min(costs, default=np.inf), one), key=lambda each: each[0])
        return best[1]

    def candidates(self, placement: Placement, photo: int) -> list[list[Pose | None]]:
        """Return cameras in which `photo` stands in some places at which most of its objects agree with the others."""
        places, costs = self._places(placement, photo)
        chosen: list[Pose] = []
        for k in np.argsort(costs):
            near = (
                np.linalg.norm(c.position - places[k].position) < _APART_M
                and rotation_angle(c.quaternion, places[k].quaternion) < np.deg2rad(_APART_DEG)
                for c in chosen
            )
            if not any(near):
                chosen.append(places[k])
            if len(chosen) == _TRIED:
                break
        return [[*placement.cameras[:photo], place, *placement.cameras[photo + 1 :]] for place in chosen]

    def _places(self, placement: Placement, photo: int) -> tuple[list[Pose], list[float]]:
        """Return where a photograph may have been taken, and the cost of each consensus."""
        places, costs = [], []
        for name, sight in self._sights[photo].items():
            for k, camera in enumerate(placement.cameras):
                if camera is not None and name in self._sights[k]:
                    there, symmetries = camera @ self._sights[k][name].poses, self._shapes[name].symmetries
                    pairs = itertools.product(range(len(there.position)), range(len(sight.poses.position)))
                    places += [there[a] @ sight.poses[b].inverse() for a, b in pairs]
                    turned = there[0] @ symmetries[1:]
                    places += [turned[s] @ sight.poses[0].inverse() for s in range(len(turned.position))]
        for place in places:
            cameras = [*placement.cameras]
            cameras[photo] = place
            costs.append(self._matched(cameras)[1])
        return places, costs

    def _matched(self, cameras: Sequence[Pose | None]) -> tuple[list[_Match], float, dict[str, Pose]]:
        """Return the poses that agree in these cameras, the cost of a consensus, and where the objects then are."""
        matches, total, poses = [], 0.0, {}
        for name, shape in self._shapes.items():
            seen = {k: self._turned[k][name] for k, camera in enumerate(cameras) if camera and name in self._turned[k]}
            if len(seen) < 2:
                continue
            count = len(shape.symmetries.position)
            there = {k: camera @ seen[k][0] for k, camera in enumerate(cameras) if camera and k in seen}
            unturned = [(k, n) for k, (its, _) in seen.items() for n in range(0, len(its.position), count)]
            tried = [(*_agreement(there, seen, k, n), there[k][n]) for k, n in unturned]
            cost, agreeing, where = min(tried, key=lambda each: each[0])
            total += cost
            if len(agreeing) > 1:
                poses[name] = where
                matches += [_Match(k, name, seen[k][0][n], n % count > 0) for k, n in agreeing.items()]
        return matches, total, poses

    def adjusted(self, cameras: Sequence[Pose | None]) -> tuple[float, Placement]:
        """Match and adjust twice; return the cost and the result."""
        _, placement = self._bundled(cameras, 1.0)
        return self._bundled(placement.cameras, placement.focal_factor)

    def _bundled(self, cameras: Sequence[Pose | None], factor: float) -> tuple[float, Placement]:
        matches, _, poses = self._matched(cameras)
        if not matches:
            return np.inf, Placement(tuple(cameras), {})
        names, count = sorted(poses), len(cameras)
        free = [k for k, camera in enumerate(cameras) if camera is not None and k not in self._fixed]
        bundle = _Bundle(self._shapes, matches, names, count)
        places = Pose.stacked([*(camera or Pose.identity() for camera in cameras), *(poses[name] for name in names)])
        moving = [*free, *range(count, count + len(names))]
        after, factor = bundle.adjusted(places, moving, factor, self._focal_known)
        off = np.linalg.norm(bundle.off(after, factor), axis=-1).mean(axis=1)
        near = [(m.photo, m.name) for m, its in zip(matches, off, strict=True) if its < _FARTHEST]
        counts = Counter(name for _, name in near)
        agreeing = frozenset(each for each in near if counts[each[1]] > 1)
        poses = {name: after[k] for k, name in enumerate(names, count) if counts[name] > 1}
        shared = sum(len(s) for s, camera in zip(self._sights, cameras, strict=True) if camera is not None)
        cost = float(np.minimum(off, _FARTHEST).sum()) + _FARTHEST * (shared - len(off))
        moved = tuple(None if camera is None else after[k] for k, camera in enumerate(cameras))
        return cost, Placement(moved, poses, agreeing, factor)


_Turned = tuple[Pose, Float[np.ndarray, "K"]]  # poses before a camera, each turned by all symmetries, and their costs


def _turned(sight: Sight, shape: Shape) -> _Turned:
    poses = Pose.joined(*(sight.poses[k] @ shape.symmetries for k in range(len(sight.losses))))
    turned = np.where(np.arange(len(shape.symmetries.position)) > 0, _TURNED_COST, 0.0)
    worse = np.clip((sight.losses - sight.losses[0]) / _LOSS_STD, 0, _MOST_COST)
    return poses, (worse[:, None] + turned).ravel()


def _agreement(
    there: Mapping[int, Pose], seen: Mapping[int, _Turned], anchor: int, number: int
) -> tuple[float, dict[int, int]]:
    """Return the cost at which others agree with one pose, and the numbers of the poses of those that do."""
    pose, cost, agreeing = there[anchor][number], float(seen[anchor][1][number]), {anchor: number}
    for k, its in there.items():
        if k != anchor:
            shifts = np.linalg.norm(its.position - pose.position, axis=-1) / _POSITION_STD_M
            turns = rotation_angle(its.quaternion, pose.quaternion) / _ROTATION_STD_RAD
            costs = shifts**2 + turns**2 + seen[k][1]
            least = int(np.argmin(costs))
            cost += min(float(costs[least]), _MOST_COST)
            if costs[least] < _MOST_COST:
                agreeing[k] = least
    return cost, agreeing


class _Bundle:
    """Points of matched objects, and where the photographs show them. Poses are of all cameras, then of the objects."""

    def __init__(
        self, shapes: Mapping[str, Shape], matches: Sequence[_Match], names: Sequence[str], cameras: int
    ) -> None:
        radius = np.array([shapes[m.name].radius for m in matches]).reshape(-1, 1, 1)
        seen = Pose.stacked(m.seen for m in matches)
        self._corners = radius * _CORNERS
        self._wanted = _projected(rotate(seen.quaternion[:, None], self._corners) + seen.position[:, None])
        std = np.array([_POINT_STD_TURNED if m.is_turned else _POINT_STD for m in matches])
        self._std = std.reshape(-1, 1, 1) * radius / seen.position[:, None, 2:]
        self._photo = np.array([m.photo for m in matches])
        self._object = np.array([cameras + names.index(m.name) for m in matches])

    def adjusted(self, places: Pose, moving: Sequence[int], factor: float, focal_known: bool) -> tuple[Pose, float]:
        """Minimise the distances by moving some poses and, if it is not known, the factor of the focal lengths."""
        start = np.zeros(6 * len(moving) + (not focal_known))
        start[6 * len(moving) :] = np.log(factor)

        def unpacked(x: np.ndarray) -> tuple[Pose, np.ndarray]:
            steps = x[..., : 6 * len(moving)].reshape(*x.shape[:-1], -1, 6)
            position, quaternion = (np.tile(a, (*x.shape[:-1], 1, 1)) for a in (places.position, places.quaternion))
            position[..., moving, :] += steps[..., :3]
            turned = quaternion_multiply(quaternion_exp(steps[..., 3:]), quaternion[..., moving, :])
            quaternion[..., moving, :] = turned
            return Pose(position, quaternion), x[..., 6 * len(moving) :]

        def residuals(x: np.ndarray) -> np.ndarray:
            poses, log_focal = unpacked(x)
            off = self.off(poses, np.exp(log_focal.sum(axis=-1)))
            return np.concatenate([log_focal / _FOCAL_STD, off.reshape(*x.shape[:-1], -1)], axis=-1)

        def jacobian(x: np.ndarray) -> np.ndarray:  # all differences at once: most of the time is NumPy's overhead
            return (residuals(x + _STEP * np.eye(len(x))) - residuals(x)).T / _STEP

        settings = {"loss": "soft_l1", "x_scale": "jac", "ftol": _TOLERANCE, "max_nfev": _EVALUATIONS}
        found = least_squares(residuals, start, jac=jacobian, **settings)  # pyright: ignore[reportArgumentType]
        after, log_focal = unpacked(found.x)
        return after, float(np.exp(log_focal.sum()))

    def off(self, places: Pose, focal: float | Float[np.ndarray, "B"]) -> Float[np.ndarray, "*B M 8 2"]:
        """Return how far points are from where they are seen, with focal lengths by a factor longer [deviations]."""
        local = places[..., self._photo, :].inverse() @ places[..., self._object, :]
        points = rotate(local.quaternion[..., None, :], self._corners) + local.position[..., None, :]
        return (np.asarray(focal)[..., None, None, None] * _projected(points) - self._wanted) / self._std


def _projected(points: Float[np.ndarray, "*batch 3"]) -> Float[np.ndarray, "*batch 2"]:
    return points[..., :2] / np.maximum(points[..., 2:], _NEAREST_M)
