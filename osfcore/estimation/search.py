"""Searches for poses and light: CMA-ES from several starts, a grid of lights, Gauss-Newton on the photometric loss."""

from __future__ import annotations

import math
import warnings
from collections.abc import Generator, Iterator, Sequence
from dataclasses import dataclass, replace

import cv2
import numpy as np
from jaxtyping import Bool, Float, Int

from osfcore.estimation.objective import (
    HUBER,
    LIGHT,
    POSE,
    QUALITY,
    ObjectModels,
    ObjectView,
    ObservedViews,
    RenderedObject,
    RestingOrientations,
    SceneParameters,
    crop_to_silhouette,
    empty_scene,
    masked_loss,
    photometric_loss,
    render_poses,
    residuals,
)
from osfcore.estimation.steps import EstimateStep, Stage
from osfcore.geometry.cameras import Camera
from osfcore.geometry.light import AMBIENT, DIFFUSE, MIN_LIGHT_ELEVATION_DEG, Light
from osfcore.geometry.poses import Pose, fibonacci_sphere, rotation_angle
from osfcore.geometry.states import EstimatedState
from osfcore.geometry.workspace import TABLE_SIDE_M
from osfcore.progress import Progress

# CMA-ES (Hansen, 2016, arXiv 1604.00772) by the `cma` library, in its ask-and-tell form.
#
# Candidates x_k ~ m + sigma N(0, C); the mean m moves to the weighted mean of the better half, and C and sigma
# adapt to the steps that succeeded.


class CMAES:
    """One search that starts at zero.

    Args:
        scales: initial standard deviation of each number of the vector; 0 holds a number fixed.
        population: candidates per generation.
        rng: random generator.
    """

    def __init__(self, scales: Float[np.ndarray, "P"], population: int, rng: np.random.Generator) -> None:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")  # it misses matplotlib, which is for its own plots
            import cma

        self._free = np.flatnonzero(scales)
        self._scales = np.asarray(scales, float)
        # A seed here would seed numpy's global generator; nan does not.
        options = {"popsize": population, "randn": lambda *shape: rng.standard_normal(shape), "seed": math.nan,
                   "verbose": -9, "verb_log": 0}  # fmt: skip
        self._strategy = cma.CMAEvolutionStrategy(np.zeros(len(self._free)), 1.0, options)
        self._asked: list[np.ndarray] = []

    def ask(self) -> Float[np.ndarray, "B P"]:
        """Return the candidates of the next generation."""
        self._asked = self._strategy.ask()
        return self._full(np.array(self._asked))

    def tell(self, losses: Float[np.ndarray, "B"]) -> None:
        """Pass the losses of the last generation. Infinite losses count as very bad."""
        self._strategy.tell(self._asked, np.nan_to_num(losses, nan=1e9, posinf=1e9).tolist())

    @property
    def mean(self) -> Float[np.ndarray, "P"]:
        """The mean of the distribution."""
        return self._full(np.asarray(self._strategy.mean)[None])[0]

    @property
    def sigma(self) -> float:
        """The overall step size, 1 at the beginning."""
        return float(self._strategy.sigma)

    def _full(self, short: np.ndarray) -> np.ndarray:
        full = np.zeros((len(short), len(self._scales)))
        full[:, self._free] = short * self._scales[self._free]
        return full


# Damped Gauss-Newton (Levenberg-Marquardt) on the photometric loss: block coordinate descent over objects and
# light.
#
# For the parameters delta of one block, with residuals r, their Jacobian J by central differences, Huber weights w
# = min(1, h / |r|) (iteratively reweighted least squares) and D = diag(J^T W J), each iteration solves
#
#     (J^T W J + lambda D) delta = -J^T W r
#
# for several lambda at once, clips delta to a trust region, renders all candidates as one batch and keeps the best
# if it lowers the loss. Deviation from the textbook: the least damped steps are also tried scaled by 4 and 2,
# because texture makes Gauss-Newton underestimate the step far from the minimum. A block's images are cropped to
# the object; what blocks share, shadows on each other, is small, and further sweeps take care of it.
#
# Deviation from the paper, which uses CMA-ES throughout: near the solution the loss is smooth over differences
# wider than a pixel, so a few iterations suffice, and J^T W J gives the uncertainty, which CMA-ES's final spread
# does not.


PLANAR_PARAMETERS = (0, 1, 5)  # among an object's numbers: x, y and the turn about the vertical
_SHIFT_M, _TURN_RAD, _LIGHT_RAD = 4e-3, 0.1, 0.02  # half the width of central differences
_MOST_SHIFT_M, _MOST_TURN_RAD, _MOST_LIGHT_RAD = 0.03, 0.4, 0.3
# lambda: these multiples of the last good one are tried at once, each with its own scale of delta.
_DAMPINGS = np.array([0.1, 0.1, 0.1, 1.0, 10.0, 100.0])
_STEP_SCALES = (4.0, 2.0, 1.0, 1.0, 1.0, 1.0)
_FIRST_DAMPING, _LEAST_DAMPING, _MOST_DAMPING = 1e-2, 1e-5, 1e6
_CONVERGED_RATIO = 0.97  # of the losses after and before a sweep, from which on it counts as converged
_TINY = 1e-9


@dataclass(frozen=True, eq=False, slots=True)
class GaussNewtonState:
    """The current iterate.

    Attributes:
        params: the best scene so far.
        losses: `photometric_loss` of each object's windows. If the light is searched, the last entry is the loss of the
            whole images.
        normals: Gauss-Newton's matrices of the summed losses, one for each object and one for the light [1 / unit^2];
            zero if nothing was searched.
        dampings: dampings of the next iteration, one for each block.
    """

    params: SceneParameters
    losses: Float[np.ndarray, "N+1"]
    normals: tuple[Float[np.ndarray, "P P"], ...]
    dampings: tuple[float, ...]

    @staticmethod
    def at(params: SceneParameters) -> GaussNewtonState:
        """Return the state before the first iteration."""
        count = len(params.names)
        normals = (*(np.zeros((POSE, POSE)) for _ in range(count)), np.zeros((LIGHT, LIGHT)))
        return GaussNewtonState(params, np.full(count + 1, np.inf), normals, (_FIRST_DAMPING,) * (count + 1))

    def undamped(self) -> GaussNewtonState:
        """Return the same iterate with the initial dampings, for another place or other images."""
        return replace(self, dampings=(_FIRST_DAMPING,) * len(self.dampings))


def gauss_newton(
    models: ObjectModels,
    views: ObservedViews,
    start: GaussNewtonState,
    *,
    iterations: int,
    objects: Sequence[int] | None = None,
    light: ObservedViews | None = None,
    numbers: Sequence[int] = range(POSE),
    until_settled: bool = False,
) -> Iterator[GaussNewtonState]:
    """Minimise the photometric loss; yield after each sweep over the objects and the light.

    Args:
        models: models of the objects and the table.
        views: the images.
        start: initial state.
        iterations: largest number of sweeps.
        objects: indices of the objects that may move; all by default.
        light: images to search the light in, which may be coarse; None to hold the light.
        numbers: indices of an object's six numbers that may change; all by default. `PLANAR_PARAMETERS` keeps it flat.
        until_settled: whether to stop when a sweep hardly lowers the objects' losses.

    Yields:
        The iterate after each sweep.
    """
    at = start
    moving = list(range(len(at.params.names)) if objects is None else objects)
    before = np.inf
    for _ in range(iterations):
        for n in moving:
            own = crop_to_silhouette(views, models, at.params, n)
            at = _damped_step(models, own, at, n, np.array([POSE * n + k for k in numbers]))
        if light is not None:
            first = POSE * len(at.params.names)
            at = _damped_step(models, light, at, len(at.params.names), np.arange(first, first + LIGHT))
        yield at
        loss = float(at.losses[moving].sum())
        if until_settled and loss > _CONVERGED_RATIO * before:
            return
        before = loss


def _damped_step(
    models: ObjectModels, views: ObservedViews, at: GaussNewtonState, block: int, numbers: Int[np.ndarray, "n"]
) -> GaussNewtonState:
    """Take one damped step on some entries of the parameter vector (the equation above)."""
    params, count = at.params, len(at.params.names)
    half = difference_steps(count)
    most = np.array([*([_MOST_SHIFT_M] * 3 + [_MOST_TURN_RAD] * (POSE - 3)) * count, *[_MOST_LIGHT_RAD] * LIGHT])
    probes = np.zeros((1 + 2 * len(numbers), params.size))
    for row, number in enumerate(numbers):
        probes[1 + 2 * row, number], probes[2 + 2 * row, number] = half[number], -half[number]
    errors = residuals(models, views, params.perturbed(probes)).reshape(len(probes), -1)
    jacobian = (errors[1::2] - errors[2::2]) / (2 * half[numbers, None].astype(np.float32))
    weights = np.minimum(1, HUBER / np.maximum(np.abs(errors[0]), _TINY))
    normal = ((jacobian * weights) @ jacobian.T).astype(float)
    gradient = jacobian @ (weights * errors[0])
    dampings = at.dampings[block] * _DAMPINGS
    steps = np.zeros((len(dampings), params.size))
    for row, (damping, scale) in enumerate(zip(dampings, _STEP_SCALES, strict=True)):
        damped = normal + np.diag(damping * np.diag(normal) + _TINY)
        steps[row, numbers] = -scale * np.linalg.solve(damped, gradient)
    steps /= np.maximum(1, (np.abs(steps) / most).max(axis=1, keepdims=True))
    here = float(photometric_loss(errors[:1])[0])
    losses = photometric_loss(residuals(models, views, params.perturbed(steps)))
    best = int(np.argmin(losses))
    if losses[best] < here:
        params, here = params.updated(steps[best]), float(losses[best])
        damping = max(float(dampings[best]), _LEAST_DAMPING)
    else:
        damping = min(float(dampings[-1]), _MOST_DAMPING)
    own = numbers - POSE * block
    losses, normals, all_dampings = at.losses.copy(), list(at.normals), list(at.dampings)
    losses[block], all_dampings[block] = here, damping
    normals[block] = np.zeros_like(at.normals[block])
    normals[block][np.ix_(own, own)] = normal
    return GaussNewtonState(params, losses, tuple(normals), tuple(all_dampings))


def difference_steps(count: int) -> Float[np.ndarray, "P"]:
    """Return half the width of the central differences of each parameter, for a scene of `count` objects."""
    return np.array([*([_SHIFT_M] * 3 + [_TURN_RAD] * (POSE - 3)) * count, *[_LIGHT_RAD] * LIGHT])


# Initial poses: positions from the masks and all resting orientations, ranked by the masked loss.


OVERHEAD = np.array([0.0, 0.0, 1.0])
_CENTRING_ROUNDS = 2
_MAX_STEP_M = 0.05
_HEIGHT_WEIGHT = 4.0  # how firmly an object lies on the table, against one view's line of sight
_MIN_PIXELS = 3.0
_DISTINCT_RAD = np.deg2rad(25.0)


@dataclass(frozen=True, eq=False, slots=True)
class RankedPoses:
    """Initial poses of one object, the best first.

    Attributes:
        poses: K poses `T_world_object`.
        losses: `masked_loss` of each.
    """

    poses: Pose
    losses: Float[np.ndarray, "K"]

    def distinct(self, count: int) -> RankedPoses:
        """Return the best `count` poses whose orientations differ by more than 25 degrees from better ones."""
        kept = distinct_orientations(self.poses.quaternion, count, _DISTINCT_RAD)
        return RankedPoses(self.poses[kept], self.losses[kept])


def distinct_orientations(quaternions: Float[np.ndarray, "K 4"], count: int, apart_rad: float) -> list[int]:
    """Return indices of the first `count` orientations that are more than `apart_rad` from all kept before."""
    kept: list[int] = []
    for k in range(len(quaternions)):
        if all(rotation_angle(quaternions[k], quaternions[other]) > apart_rad for other in kept):
            kept.append(k)
        if len(kept) == count:
            break
    return kept


def initial_poses(models: ObjectModels, name: str, part: ObjectView) -> RankedPoses:
    """Return all resting orientations of an object at the position of its masks, ranked by the masked loss.

    They are rendered under a light overhead of unknown brightness, since the true light is not known yet.

    Args:
        models: models of the objects and the table.
        name: name of the object.
        part: windows around its masks.
    """
    poses = _poses_along_rays(part, models.resting(name))
    for _ in range(_CENTRING_ROUNDS):
        look = render_poses(models, name, part, poses, OVERHEAD)
        poses = Pose(_centre_on_mask(look, part, poses.position), poses.quaternion)
    return rank_poses(models, name, part, poses, OVERHEAD, any_brightness=True)


def rank_poses(
    models: ObjectModels,
    name: str,
    part: ObjectView,
    poses: Pose,
    light: Float[np.ndarray, "3"],
    *,
    any_brightness: bool = False,
) -> RankedPoses:
    """Sort poses by their masked loss, the best first.

    Args:
        models: models of the objects and the table.
        name: name of the object.
        part: windows around its masks.
        poses: a batch of `T_world_object`.
        light: unit vector toward the light.
        any_brightness: compare colours up to a factor, see `masked_loss`.
    """
    losses = masked_loss(render_poses(models, name, part, poses, light), part, any_brightness=any_brightness)
    order = np.argsort(losses)
    return RankedPoses(poses[order], losses[order])


def _poses_along_rays(part: ObjectView, resting: RestingOrientations) -> Pose:
    """Place resting orientations so that the centre of mass is closest to the rays through the masks' centroids.

    The orientation nearly determines the height over the table, so that one view is enough.
    """
    normal, target = np.zeros((3, 3)), np.zeros(3)
    for camera, mask, weight in zip(part.cameras, part.mask, np.sqrt(part.area / part.area.max()), strict=True):
        rows, columns = np.nonzero(mask > 0.5)
        pixel = np.array([columns.mean() + 0.5, rows.mean() + 0.5])
        direction = camera.ray_directions(pixel)
        across = weight * (np.eye(3) - np.outer(direction, direction))
        normal += across
        target += across @ camera.T_world_camera.position
    up = np.diag([0.0, 0.0, _HEIGHT_WEIGHT])
    heights = np.outer(resting.heights, (0.0, 0.0, _HEIGHT_WEIGHT))
    centres = np.linalg.solve(normal + up, (target + heights).T).T
    centres[:, :2] = np.clip(centres[:, :2], -TABLE_SIDE_M / 2, TABLE_SIDE_M / 2)
    return resting.poses_at(centres, resting.quaternions)


def _centre_on_mask(
    look: RenderedObject, part: ObjectView, positions: Float[np.ndarray, "B 3"]
) -> Float[np.ndarray, "B 3"]:
    """Move positions, by least squares over the views, so that silhouettes have the centroids of the masks."""
    wanted, _ = _centroids(part.mask * part.valid)
    found, sizes = _centroids(look.opacity * part.valid)
    normal = np.tile(np.diag([1e-3, 1e-3, 1e-3]), (len(positions), 1, 1))
    target = np.zeros((len(positions), 3))
    for view, camera in enumerate(part.cameras):
        slope = _projection_slope(camera, positions)
        slope = slope * (sizes[:, view] > _MIN_PIXELS)[:, None, None]
        normal += np.swapaxes(slope, 1, 2) @ slope
        target += np.einsum("bij,bi->bj", slope, wanted[view] - found[:, view])
    if len(part.cameras) == 1:  # one view does not separate distance from size; the object lies on the table
        normal[:, 2, 2] += 1e9
    step = np.linalg.solve(normal, target[..., None])[..., 0]
    length = np.linalg.norm(step, axis=1, keepdims=True)
    return positions + step * np.minimum(1, _MAX_STEP_M / np.maximum(length, 1e-9))


def _centroids(weights: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return the centroids (x, y) of images [px], and the sums of their pixels."""
    rows, columns = np.mgrid[: weights.shape[-2], : weights.shape[-1]] + 0.5
    total = weights.sum(axis=(-2, -1))
    moments = np.stack([(weights * columns).sum(axis=(-2, -1)), (weights * rows).sum(axis=(-2, -1))], axis=-1)
    return moments / np.maximum(total, 1e-6)[..., None], total


def _projection_slope(camera: Camera, points: Float[np.ndarray, "B 3"]) -> Float[np.ndarray, "B 2 3"]:
    """Return the derivatives of pixel coordinates by a point in the world [px / m]."""
    inverse = camera.T_world_camera.inverse().matrix()
    x, y, z = (points @ inverse[:3, :3].T + inverse[:3, 3]).T
    z = np.maximum(z, 1e-3)
    fx, fy = camera.intrinsics[0, 0], camera.intrinsics[1, 1]
    zero = np.zeros_like(x)
    slope = np.stack([np.stack([fx / z, zero, -fx * x / z**2], -1), np.stack([zero, fy / z, -fy * y / z**2], -1)], 1)
    return slope @ inverse[:3, :3]


# CMA-ES over poses: of one object by the masked loss (paper eq. 5), of scenes by the photometric loss (eq. 6).
#
# There are two searches. An object within its masks is searched from several starts at once. A scene is searched around
# one guess, which is a candidate of each generation, so that the result is never worse.


SHIFT_M, TURN_RAD = 4e-3, 0.12  # the first spread


class MultistartCMA:
    """One CMA-ES by the masked loss for each start of an object. One generation of all is rendered as one batch.

    Args:
        models: models of the objects and the table.
        name: name of the object.
        part: windows around its masks.
        starts: initial poses.
        light: unit vector toward the light.
        population: candidates per generation and start.
        rng: random generator of the searches.
        any_brightness: whether the light is not known yet, see `masked_loss`.
    """

    def __init__(
        self,
        models: ObjectModels,
        name: str,
        part: ObjectView,
        starts: RankedPoses,
        light: Float[np.ndarray, "3"],
        *,
        population: int,
        rng: np.random.Generator,
        any_brightness: bool,
    ) -> None:
        self._models, self._name, self._part, self._starts, self._light = models, name, part, starts.poses, light
        self._any_brightness = any_brightness
        scales = np.array([SHIFT_M] * 3 + [TURN_RAD] * 3 + [0.0] * LIGHT)
        begun = zip(starts.poses.position, starts.poses.quaternion, strict=True)
        self._guesses = [SceneParameters((name,), p[None], q[None], light, None) for p, q in begun]
        self._searches = [CMAES(scales, population, rng) for _ in self._guesses]

    @property
    def sigma(self) -> float:
        """Step size of the first start's search, 1 at the beginning."""
        return self._searches[0].sigma

    def advance(self) -> tuple[Pose, float]:
        """Evaluate one more generation of every search; return its candidates, and the loss of the best."""
        batches = [g.perturbed(s.ask()) for g, s in zip(self._guesses, self._searches, strict=True)]
        tried = Pose.joined(*(Pose(b.positions[:, 0], b.quaternions[:, 0]) for b in batches))
        look = render_poses(self._models, self._name, self._part, tried, self._light)
        losses = masked_loss(look, self._part, any_brightness=self._any_brightness)
        for search, own in zip(self._searches, losses.reshape(len(batches), -1), strict=True):
            search.tell(own)
        return tried, float(losses.min())

    def best_poses(self) -> Pose:
        """Return the starts, and the mean of each search."""
        now = [g.updated(s.mean) for g, s in zip(self._guesses, self._searches, strict=True)]
        return Pose.joined(self._starts, *(Pose(g.positions, g.quaternions) for g in now))


@dataclass(frozen=True, eq=False, slots=True)
class SceneGeneration:
    """One generation of a search for a scene.

    Attributes:
        best: the best scene so far.
        loss: its photometric loss.
        tried: poses of the C candidates, a batch for each object.
        lights: unit vectors toward the light of the candidates.
        sigma: overall step size of the search, 1 at the beginning.
    """

    best: SceneParameters
    loss: float
    tried: list[Pose]
    lights: Float[np.ndarray, "C 3"]
    sigma: float


def search_scene(
    models: ObjectModels,
    views: ObservedViews,
    start: SceneParameters,
    scales: Float[np.ndarray, "P"],
    *,
    population: int,
    generations: int,
    rng: np.random.Generator,
) -> Iterator[SceneGeneration]:
    """Minimise the photometric loss around a guess by CMA-ES.

    Args:
        models: models of the objects and the table.
        views: whole images or windows.
        start: the guess, which is a candidate of every generation.
        scales: initial standard deviation of each number of the parameter vector; 0 holds a number fixed.
        population: candidates per generation, besides the guess.
        generations: number of generations.
        rng: random generator of the search.

    Yields:
        Each generation.
    """
    search, best, least = CMAES(scales, population, rng), start, np.inf
    for _ in range(generations):
        batch = start.perturbed(np.concatenate([np.zeros((1, start.size)), search.ask()]))
        losses = photometric_loss(residuals(models, views, batch))
        search.tell(losses[1:])
        k = int(np.argmin(losses))
        if losses[k] < least:
            least, found = float(losses[k]), (batch.positions[k], batch.quaternions[k], batch.lights[k])
            best = replace(start, positions=found[0], quaternions=found[1], light=found[2])
        tried = [Pose(batch.positions[:, n], batch.quaternions[:, n]) for n in range(len(start.names))]
        yield SceneGeneration(best, least, tried, batch.lights, search.sigma)


# Light search: the direction toward the light by coarse-to-fine grid search, given roughly known poses.
#
# A grid over the hemisphere and a ring at the elevation that the table's shading gives, then shrinking 3 x 3 grids
# around the best directions, ranked by the truncated absolute error mean(min(|r|, e_max)) of renderings with
# shadows. Lit parts of the table reflect ambient + direct * sin(elevation); cast shadows give the azimuth; neither
# needs accurate poses. Without the ring lights near the horizon are missed: there shading changes by half from one
# direction to the next. The fit of unknown exposure (`photometry.py`) shares the grid and its refinement, but not
# the error: there gains are solved for at each direction.


_DIRECTIONS = 300  # over the whole sphere: about 12 degrees apart
_AZIMUTHS = 48  # of a ring at the horizon; higher ones are shorter
FIRST_STEP_RAD = np.deg2rad(8.0)
LIGHT_ROUNDS, SHRINKING = 6, 0.6  # of the step from round to round
_MAX_ERROR = 0.25  # e_max [radiance]: orientations may still be wrong
_FIRST_SURVIVORS, _SURVIVORS = 6, 3  # local minima arise where shadows fall on other objects
_NEIGHBOUR_OFFSETS = np.array([(a, b) for a in (0, -1, 1) for b in (0, -1, 1)], float)
TABLE_COLOUR = 0.012  # error of a pixel's colours up to which it shows the table [radiance]
_LIT, _FEWEST_LIT = 0.03, 20  # least x of a lit pixel, and how many each picture needs


def search_light(
    models: ObjectModels, coarse: ObservedViews, fine: ObservedViews, params: SceneParameters
) -> Float[np.ndarray, "3"]:
    """Find the light under which a rendering of the guessed poses fits the images best.

    Args:
        models: models of the objects and the table.
        coarse: images to try the whole hemisphere on.
        fine: images to refine on.
        params: objects and pusher. The light is ignored.

    Returns:
        The unit vector toward the light.
    """
    directions = np.concatenate([hemisphere(), _ring(models, fine)])
    best = directions[np.argsort(_losses(models, coarse, params, directions))[:_FIRST_SURVIVORS]]
    step = FIRST_STEP_RAD
    for _ in range(LIGHT_ROUNDS):
        tried = np.concatenate([light_neighbours(params, light, step) for light in best])
        best = tried[np.argsort(_losses(models, fine, params, tried))[:_SURVIVORS]]
        step *= SHRINKING
    return best[0]


def light_loss_ratio(models: ObjectModels, views: ObservedViews, params: SceneParameters) -> float:
    """Return the least truncated error on the grid over the hemisphere, divided by the error under the guess's light.

    Args:
        models: models of the objects and the table.
        views: images to compare with, which may be coarse.
        params: guess of the scene.
    """
    directions = np.concatenate([params.light[None], hemisphere()])
    losses = _losses(models, views, params, directions)
    return float(losses[1:].min() / max(losses[0], 1e-12))


def hemisphere(count: int = _DIRECTIONS) -> Float[np.ndarray, "K 3"]:
    """Return those of `count` directions, spread over the whole sphere, that are high enough for a light."""
    directions = fibonacci_sphere(count)
    return directions[directions[:, 2] > np.sin(np.deg2rad(MIN_LIGHT_ELEVATION_DEG))]


def _ring(models: ObjectModels, views: ObservedViews) -> Float[np.ndarray, "K 3"]:
    """Return directions from all around at the elevation of the table's lit pixels; none if no lit pixel is visible."""
    level = lit_table_level(models, views)
    if level is None:
        return np.zeros((0, 3))
    elevation = np.arcsin(np.clip(level, np.sin(np.deg2rad(MIN_LIGHT_ELEVATION_DEG)), 1))
    count = int(np.ceil(_AZIMUTHS * np.cos(elevation))) + 1
    azimuths = 2 * np.pi * np.arange(count) / count
    return np.stack([Light.from_angles(azimuth, elevation).direction for azimuth in azimuths])


def light_neighbours(params: SceneParameters, light: Float[np.ndarray, "3"], step: float) -> Float[np.ndarray, "9 3"]:
    """Return a direction toward the light and eight around it, `step` [rad] apart.

    Args:
        params: a scene, of which only the size of the parameter vector is used.
        light: the direction in the middle, a unit vector.
        step: step of the grid [rad].
    """
    changes = np.zeros((len(_NEIGHBOUR_OFFSETS), params.size))
    changes[:, -LIGHT:] = step * _NEIGHBOUR_OFFSETS
    return replace(params, light=light).perturbed(changes).lights


def _losses(
    models: ObjectModels, views: ObservedViews, params: SceneParameters, lights: np.ndarray
) -> Float[np.ndarray, "B"]:
    batch = replace(params.repeated(len(lights)), lights=lights)
    rendered = models.together.render(batch, views.cameras, quality=QUALITY)
    return np.minimum(np.abs(rendered.rgb - views.images), _MAX_ERROR).mean(axis=(1, 2, 3, 4))


def table_light(
    models: ObjectModels, views: ObservedViews
) -> tuple[Float[np.ndarray, "V h w"], Float[np.ndarray, "V h w"], Bool[np.ndarray, "V h w"]]:
    """Fit the light on the table to each pixel, as if every pixel showed the table.

    Args:
        models: models, of which only the table is used.
        views: the images.

    Returns:
        The light x that explains each pixel best, the remaining error of its colours [radiance], and whether the pixel
        would show the table if the table were empty.
    """
    empty = models.together.render(empty_scene(OVERHEAD), views.cameras, quality=QUALITY, outputs={"rgb", "depth"})
    assert empty.depth is not None
    full = empty.rgb[0]
    seen = np.stack([cv2.blur(image, (3, 3)) for image in views.images])
    # The known table facing the lamp sends out `full`, that is ambient and all direct light.
    lit = (seen * full).sum(axis=-1) / np.maximum((full * full).sum(axis=-1), 1e-6)
    error = np.abs(seen - lit[..., None] * full).mean(axis=-1)
    return (lit - AMBIENT) / DIFFUSE, error, empty.depth[0] > 0


def lit_table_level(models: ObjectModels, views: ObservedViews) -> float | None:
    """Return the light x = sin(elevation) on the lit part of the table: the median over its pixels.

    Args:
        models: models, of which only the table is used.
        views: the images. Masks are ignored.

    Returns:
        x, or None if too little of the lit table is visible.
    """
    x, error, on_table = table_light(models, views)
    lit = x[on_table & (error < TABLE_COLOUR) & (x > _LIT)]
    return float(np.median(lit)) if len(lit) >= _FEWEST_LIT * len(views.images) else None


# Builds the steps that an estimator yields.


class StepReporter:
    """Builds the steps of one estimation and counts them.

    Args:
        total: expected number of steps, which may grow.
    """

    def __init__(self, total: int) -> None:
        self.done, self.total = 0, total

    def step(
        self,
        stage: Stage,
        note: str,
        params: SceneParameters,
        tried: Sequence[Pose] = (),
        losses: Sequence[float] = (),
        sigma: float = 1.0,
        lights: Float[np.ndarray, "C 3"] | None = None,
        loss: float = float("nan"),
    ) -> EstimateStep:
        """Build the next step.

        Args:
            stage: the part of the method that is running.
            note: what it does, for people.
            params: the best scene so far.
            tried: poses of each object that were tried. They are shown if every object has some.
            losses: losses of each object.
            sigma: overall step size of the search.
            lights: unit vectors toward the lights that were tried.
            loss: loss of the whole.
        """
        self.done = min(self.done + 1, self.total)
        candidates = None
        count = min((len(poses.position) for poses in tried), default=0) if len(tried) == len(params.names) else 0
        if count:
            candidates = Pose(
                np.stack([poses.position[:count] for poses in tried], 1),
                np.stack([poses.quaternion[:count] for poses in tried], 1),
            )
        progress = Progress(self.done, self.total, note)
        return EstimateStep(progress, stage, params.state(), candidates, lights, sigma, tuple(losses), loss)

    def refinement(self, note: str, at: GaussNewtonState, stage: Stage = "polish") -> EstimateStep:
        """Build the next step from a state of Gauss-Newton."""
        return self.step(stage, note, at.params, losses=at.losses[:-1].tolist(), loss=float(at.losses[-1]))

    def refinements(
        self, note: str, at: GaussNewtonState, sweeps: Iterator[GaussNewtonState]
    ) -> Generator[EstimateStep, None, GaussNewtonState]:
        """Yield a step for each sweep of Gauss-Newton that began at `at`; return the last state."""
        for sweep in sweeps:
            at = sweep
            yield self.refinement(note, at)
        return at

    def finish(self, at: GaussNewtonState, estimate: EstimatedState) -> EstimateStep:
        """Build the last step, with the result."""
        self.done = self.total - 1
        step = self.refinement("Done" if estimate.trusted else estimate.reason, at)
        return replace(step, stage="done", estimate=estimate)
