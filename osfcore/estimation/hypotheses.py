"""Hypotheses that descent does not reach: other orientations, objects found by templates, and scenes of both."""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from dataclasses import dataclass, replace
from itertools import combinations

import numpy as np
from jaxtyping import Float, Int
from scipy.spatial import KDTree

from osfcore.estimation.objective import (
    QUALITY,
    ObjectModels,
    ObservedViews,
    SceneParameters,
    crop_camera,
    crop_to_object,
    empty_scene,
    full_circle,
    loss_of,
    pose_losses,
    yaw_quaternions,
)
from osfcore.estimation.search import (
    OVERHEAD,
    GaussNewtonState,
    distinct_orientations,
    gauss_newton,
    hemisphere,
    lit_table_level,
    search_light,
)
from osfcore.estimation.uncertainty import evaluate_fit, object_residuals
from osfcore.geometry.cameras import Camera
from osfcore.geometry.light import AMBIENT, DIFFUSE
from osfcore.geometry.poses import Pose, quaternion_conjugate, quaternion_exp, quaternion_multiply, rotate
from osfcore.geometry.workspace import TABLE_SIDE_M, WORKSPACE_HALF_M
from osfcore.render.types import SceneBatch

# Orientation hypotheses of one object, refined by Gauss-Newton and compared by the photometric loss around it.


_YAWS = 24
_DOWN = np.array([0.0, 0.0, -1.0])
_RANKED_COARSE = 64  # hypotheses that are ranked again in coarse images
_REFINED_ROUGH = 8  # of these, so many that differ are refined in rough images
_REFINED_COARSE = 3  # of these, so many are refined in coarse ones
_ITERATIONS, _FINE_ITERATIONS = 2, 3
_FAR, _EXPLAINED = 1.5, 0.035  # nothing is refined where all losses are as high and it differs by less [radiance]
_CLOSE = 1.5  # ratio to the present loss up to which a hypothesis is refined on fine images
_BETTER = 0.98  # times the loss: what is less is no reason to turn an object
_SAME_RAD = np.deg2rad(12.0)


def yaw_hypotheses(models: ObjectModels, params: SceneParameters, number: int) -> Pose:
    """Return a batch of poses of an object turned about the vertical through its centre of mass, in equal steps.

    Args:
        models: models of the objects, for the centre of mass.
        params: the guess. The result does not contain the object's present pose.
        number: index of the object.
    """
    quaternions = quaternion_multiply(full_circle(_YAWS)[1:], params.quaternions[number][None])
    return models.resting(params.names[number]).poses_at(models.centre_of_mass(params, number), quaternions)


def side_hypotheses(models: ObjectModels, params: SceneParameters, number: int) -> Pose:
    """Return a batch of poses of an object tipped over, by the smallest rotation, onto each side that it may lie on.

    For a can on its side this includes rolling about its axis: a label that repeats around it makes these poses look
    alike in coarse images. Each pose comes also turned by 180 deg about the vertical. The axis of a rotation by about
    180 deg is the object's longest one.

    Args:
        models: models of the objects, for the sides and the centre of mass.
        params: the guess. The result does not contain the side that the object lies on.
        number: index of the object.
    """
    resting, own = models.resting(params.names[number]), params.quaternions[number]
    sides = rotate(quaternion_conjugate(resting.quaternions), _DOWN)
    sides, first = np.unique(np.round(sides, 6), axis=0, return_index=True)
    now = rotate(own, sides)
    axes, angles = np.cross(now, _DOWN), np.arccos((now @ _DOWN).clip(-1, 1))
    longest = rotate(own, np.linalg.svd(resting.hull - resting.hull.mean(axis=0), full_matrices=False)[2][0])
    axes[angles > np.pi - _SAME_RAD] = longest * [1, 1, 0]
    other = angles > _SAME_RAD
    turns = axes[other] / np.linalg.norm(axes[other], axis=1, keepdims=True).clip(1e-9) * angles[other, None]
    tipped = quaternion_multiply(quaternion_exp(turns), own[None])
    quaternions = np.concatenate([tipped, quaternion_multiply(yaw_quaternions(np.array([np.pi])), tipped)])
    middle = np.tile(models.centre_of_mass(params, number), (len(quaternions), 1))
    middle[:, 2] = np.tile(resting.heights[first][other], 2)
    return resting.poses_at(middle, quaternions)


def compare_orientations(
    models: ObjectModels,
    rough: ObservedViews,
    coarse: ObservedViews,
    fine: ObservedViews,
    at: GaussNewtonState,
    number: int,
    others: Pose,
) -> tuple[GaussNewtonState, float]:
    """Compare an object's orientation with the best of other hypotheses.

    No hypothesis is refined if the object explains its pixels already and all hypotheses are far worse. Residuals were
    at most 0.038 with right orientations, and at least 0.038 with wrong ones (`docs/notes/estimation.md`).

    Args:
        models: models of the objects and the table.
        rough: images to rank hypotheses in and refine them first. They have the widest basins of attraction.
        coarse: images to rank the best hypotheses in again, and to refine them further.
        fine: images to compare the best hypothesis in.
        at: the scene so far.
        number: index of the object.
        others: a batch of other poses of the object.

    Returns:
        The better scene, and the ratio of the worse loss to the better one; infinite if no hypothesis differs.
    """
    name, own_quaternion = at.params.names[number], at.params.quaternions[number]
    far = others[models.turned(name, own_quaternion, others.quaternion) > _SAME_RAD]
    if not len(far.position):
        return at, np.inf
    own = crop_to_object(rough, models, at.params, number)
    far = far[np.argsort(pose_losses(models, own, at.params, number, far))[:_RANKED_COARSE]]
    own = crop_to_object(coarse, models, at.params, number)
    losses = pose_losses(models, own, at.params, number, far)
    far, nearest = far[np.argsort(losses)], float(losses.min() / max(loss_of(models, own, at.params), 1e-12))
    if nearest > _FAR and object_residuals(evaluate_fit(models, fine, at.params))[number] < _EXPLAINED:
        return at, nearest
    begun = distinct_orientations(far.quaternion, _REFINED_ROUGH, _SAME_RAD * 1.5)
    tried = [_refine(models, rough, at, number, far[k], _ITERATIONS) for k in begun]
    tried = sorted(tried, key=lambda one: loss_of(models, own, one.params))[:_REFINED_COARSE]
    tried = [_refine(models, coarse, one, number, one.params.pose(number), _ITERATIONS) for one in tried]
    ends = [loss_of(models, own, refined.params) for refined in tried]
    rival = tried[int(np.argmin(ends))]
    if min(ends) < _CLOSE * loss_of(models, own, at.params):
        rival = _refine(models, fine, rival, number, rival.params.pose(number), _FINE_ITERATIONS)
    own = crop_to_object(fine, models, at.params, number)
    here, there = (loss_of(models, own, params) for params in (at.params, rival.params))
    angle = models.turned(name, own_quaternion, rival.params.quaternions[number][None])[0]
    ratio = np.inf if angle < _SAME_RAD else max(here, there) / max(min(here, there), 1e-12)
    return (replace(rival, losses=at.losses) if there < _BETTER * here else at), float(ratio)


def _refine(
    models: ObjectModels, views: ObservedViews, at: GaussNewtonState, number: int, pose: Pose, iterations: int
) -> GaussNewtonState:
    """Refine one object from a pose by Gauss-Newton. Its normal matrix stays the same until it moves."""
    rival = replace(at.undamped(), params=at.params.with_pose(number, pose))
    return list(gauss_newton(models, views, rival, iterations=iterations, objects=(number,)))[-1]


# Finding an object in one image without a mask: templates slid over the image, under every light at once.
#
# A matte object under any distant light looks nearly like a mixture of its images under four lights. A template
# consists of these four images. At each place, the best mixture is a small least-squares problem. The score of a place
# is how much better the mixture explains the pixels than the bare table, lit or in shadow.


_BASIS = np.array([[0, 0, 1.0], [0.8, 0, 0.6], [-0.4, 0.48**0.5, 0.6], [-0.4, -(0.48**0.5), 0.6]])  # toward the lights
_REACH_M = WORKSPACE_HALF_M + 0.06
_ANCHORS = 5  # along each side of the workspace; templates are rendered there, and slid by half the way between two
_BLOCK_M = 0.025  # side of a square from which each orientation is kept once
_RIDGE = 0.05
_MAX_TABLE_ERROR = 0.3
_UNEVEN = 0.03  # share by which pixels of the lit table may differ
_NEAR_M, _NEAR_RAD = 0.02, np.deg2rad(20.0)


@dataclass(frozen=True, eq=False, slots=True)
class TemplateMatches:
    """Poses that an object may have in an image, the most likely first.

    Attributes:
        poses: K poses `T_world_object`.
        scores: how much better each pose explains its pixels than the table does.
    """

    poses: Pose
    scores: Float[np.ndarray, "K"]

    @staticmethod
    def none() -> TemplateMatches:
        """Return empty matches, of an object that was not found."""
        return TemplateMatches(Pose.identity(0), np.zeros(0))


def table_errors(models: ObjectModels, views: ObservedViews, lit: float | None = None) -> Float[np.ndarray, "h w"]:
    """Return the squared error of each pixel of the first view if it shows the table.

    Args:
        models: models of the objects and the table.
        views: the images.
        lit: light on the lit table, see `lit_table_level`. Each pixel then shows the lit table or shadow. If None, any
            brightness is accepted, so that grey objects look like table as well.
    """
    table = models.together.render(empty_scene(OVERHEAD), views.cameras[:1], quality=QUALITY).rgb[0, 0]
    image = views.images[0]
    share = (image * table).sum(axis=-1) / np.maximum((table * table).sum(axis=-1), 1e-6)
    errors = np.full(share.shape, _MAX_TABLE_ERROR**2)
    full = AMBIENT + DIFFUSE * (lit or 0)
    for low, high in [(0.2, 1.05)] if lit is None else [(0.2, AMBIENT), ((1 - _UNEVEN) * full, (1 + _UNEVEN) * full)]:
        left = image - table * np.clip(share, low, high)[..., None]
        errors = np.minimum(errors, (left**2).sum(axis=-1))
    return errors


def scene_errors(models: ObjectModels, views: ObservedViews, params: SceneParameters) -> Float[np.ndarray, "h w"]:
    """Return the squared error of each pixel of the first view, summed over the colours and truncated.

    Args:
        models: models of the objects and the table.
        views: the images, of which only the first is used.
        params: the scene to render, such as the objects found so far.
    """
    rendered = models.together.render(params.repeated(), views.cameras[:1], quality=QUALITY)
    return np.minimum(((views.images[0] - rendered.rgb[0, 0]) ** 2).sum(axis=-1), _MAX_TABLE_ERROR**2)


def match_templates(
    models: ObjectModels,
    views: ObservedViews,
    name: str,
    quaternions: Float[np.ndarray, "K 4"],
    heights: Float[np.ndarray, "K"],
    *,
    most: int,
    behind: Float[np.ndarray, "h w"] | None = None,
    light: Float[np.ndarray, "3"] | None = None,
) -> TemplateMatches:
    """Search an object in the first view, in given orientations and at given heights of its origin [m].

    Args:
        models: models of the objects and the table.
        views: the images.
        name: name of the object.
        quaternions: quaternions of the orientations.
        heights: height of the origin above the table for each orientation [m].
        most: largest number of matches.
        behind: squared errors of the pixels without the object; those of the bare table by default.
        light: unit vector toward the light; None to allow any light.
    """
    lights = _BASIS if light is None else light[None]
    camera, image = views.cameras[0], views.images[0]
    table = table_errors(models, views, lit_table_level(models, views)) if behind is None else behind
    pixels = np.concatenate([image, table[..., None]], axis=-1)
    grid = np.linspace(-1, 1, 2 * _ANCHORS + 1)[1::2] * _REACH_M
    found = [
        _match_at_anchor(models, camera, pixels, name, quaternions, heights, lights, (x, y)) for x in grid for y in grid
    ]
    positions, turns, scores = (np.concatenate(parts) for parts in zip(*found, strict=True))
    return _non_maximum_suppression(Pose(positions, turns), scores, most)


def _match_at_anchor(
    models: ObjectModels,
    camera: Camera,
    pixels: np.ndarray,
    name: str,
    quaternions: np.ndarray,
    heights: np.ndarray,
    lights: np.ndarray,
    anchor: tuple[float, float],
) -> tuple[np.ndarray, ...]:
    """Return the best places of each orientation around an anchor: positions, orientations, scores."""
    resting = models.resting(name)
    positions = np.column_stack([np.tile(anchor, (len(heights), 1)), heights])
    centre = positions[0] + rotate(quaternions[0], resting.centre)
    nothing = np.zeros((0, 3)), np.zeros((0, 4)), np.zeros(0)
    depth = float(camera.T_world_camera.inverse().apply(centre)[2])
    if depth < resting.radius:
        return nothing  # behind the camera, or around it
    height, width = pixels.shape[:2]
    per_metre = camera.intrinsics[0, 0] / depth
    half = int(np.clip(np.ceil(1.15 * resting.radius * per_metre) + 1, 8, min(height, width) // 2))
    shift = min(int(np.ceil(_REACH_M / _ANCHORS * per_metre)) + 1, max(height, width) // 2)
    x, y = (int(v) for v in np.round(camera.project(centre)) - half)
    if not (-2 * half < x < width and -2 * half < y < height):
        return nothing  # the camera does not look there
    patches, places = _patches(pixels, x, y, 2 * half, shift)
    window = crop_camera(camera, x, y, 2 * half, 2 * half)
    scores = _scores(models, window, name, positions, quaternions, lights, patches)
    best = _best_per_block(scores, places, _BLOCK_M * per_metre)
    scores, places = np.take_along_axis(scores, best, axis=0).ravel(), places[best.ravel()]
    quaternions, heights = (np.tile(a, (len(best),) + (1,) * (a.ndim - 1)) for a in (quaternions, heights))
    directions = camera.ray_directions(np.tile(camera.project(positions), (len(best), 1)) + places)
    eye = camera.T_world_camera.position
    far = (heights - eye[2]) / np.minimum(directions[:, 2], -1e-3)
    found = eye + far[:, None] * directions
    on_table = np.abs(found[:, :2]).max(axis=1) < TABLE_SIDE_M / 2  # toward the horizon a pixel is many metres
    return found[on_table], quaternions[on_table], scores[on_table]


def _best_per_block(scores: np.ndarray, places: np.ndarray, side: float) -> Int[np.ndarray, "B K"]:
    """Return the window with the best score of each template, in each square block of shifted windows."""
    blocks = np.floor(places / max(side, 1.0)).astype(int)
    members = [np.flatnonzero((blocks == block).all(axis=1)) for block in np.unique(blocks, axis=0)]
    return np.stack([own[scores[own].argmax(axis=0)] for own in members])


def _patches(image: np.ndarray, x: int, y: int, side: int, shift: int) -> tuple[np.ndarray, np.ndarray]:
    """Cut shifted windows out of an image, S x side x side x c; return them and their shifts (x, y) [px].

    Pixels beyond the image's border are black and count as table.
    """
    border = side + shift
    wide = np.pad(image, ((border, border), (border, border), (0, 0)))
    top, left = y + border - shift, x + border - shift
    part = wide[top : top + side + 2 * shift, left : left + side + 2 * shift]
    windows = np.moveaxis(np.lib.stride_tricks.sliding_window_view(part, (side, side), axis=(0, 1)), 2, -1)
    rows, columns = np.mgrid[: windows.shape[0], : windows.shape[1]] - shift
    offsets = np.column_stack([columns.ravel(), rows.ravel()])
    return windows.reshape(-1, side, side, image.shape[-1]), offsets


def _scores(
    models: ObjectModels, camera: Camera, name: str, positions: np.ndarray, quaternions: np.ndarray,
    directions: np.ndarray, patches: np.ndarray,
) -> Float[np.ndarray, "S K"]:  # fmt: skip
    """Return how much better each of K templates explains each of S windows than the table does."""
    count, lights = len(positions), len(directions)
    batch = SceneBatch(
        (name,),
        np.repeat(positions, lights, axis=0)[:, None],
        np.repeat(quaternions, lights, axis=0)[:, None],
        np.tile(directions, (count, 1)),
        None,
    )
    rendered = models.alone.render(batch, (camera,), quality=QUALITY, outputs={"rgb", "opacity"})
    assert rendered.opacity is not None
    mask = (rendered.opacity[::lights, 0, 0] > 0.5).reshape(count, -1).astype(np.float32)
    basis = rendered.rgb[:, 0].reshape(count, lights, -1) * np.repeat(mask, 3, axis=-1)[:, None]
    pixels = patches[..., :3].reshape(len(patches), -1).astype(np.float32)
    gram = basis @ np.swapaxes(basis, 1, 2)
    gram += _RIDGE * np.trace(gram, axis1=1, axis2=2)[:, None, None] / lights * np.eye(lights) + 1e-6 * np.eye(lights)
    seen = (pixels @ basis.reshape(count * lights, -1).T).reshape(len(patches), count, lights)
    explained = np.einsum("skl,klm,skm->sk", seen, np.linalg.inv(gram), seen, optimize=True)
    squares = (pixels**2).reshape(len(patches), -1, 3).sum(axis=-1) @ mask.T
    of_table = patches[..., 3].reshape(len(patches), -1) @ mask.T
    return of_table - (squares - explained)


def _non_maximum_suppression(poses: Pose, scores: np.ndarray, most: int) -> TemplateMatches:
    """Keep the best matches that differ in place or orientation."""
    order = np.argsort(-scores)
    poses, scores = poses[order], scores[order]
    tree, kept, left = KDTree(poses.position), [], np.ones(len(scores), bool)
    for k in range(len(scores)):
        if len(kept) == most:
            break
        if left[k]:
            kept.append(k)
            near = np.array(tree.query_ball_point(poses.position[k], _NEAR_M))
            alike = np.abs(poses.quaternion[near] @ poses.quaternion[k]) >= np.cos(_NEAR_RAD / 2)
            left[near[alike]] = False
    return TemplateMatches(poses[kept], scores[kept])


# Scenes made of matches: which matches explain an image together, under an unknown light.
#
# Objects and light depend on each other: under a wrong light a wrong scene may look right. The search therefore begins
# under lights all over the hemisphere, on rough images, and compares the best scenes on finer images. Finally, objects
# are replaced two at a time, because an object in the place of another one blocks that place.


OUT_OF_VIEW = Pose(np.array([0.0, 0.0, -1.0]), np.array([1.0, 0.0, 0.0, 0.0]))  # below the table: not in the image
_LIGHTS = 40  # over the whole sphere, to begin with
_FEW_LIGHTS = 10
_KEPT_ROUGH, _KEPT = 8, 3  # of the scenes found under them, for another round, and for one on finer images
_PLACES, _APART_M, _SECOND = 8, 0.03, 40  # places tried for the first of two objects, matches for the second


def reassign_poses(
    models: ObjectModels, views: ObservedViews, params: SceneParameters, matches: list[TemplateMatches]
) -> SceneParameters:
    """Move each object in turn to a match that explains the whole images better than its pose, if there is one.

    Args:
        models: models of the objects and the table.
        views: images to compare with.
        params: guess of the scene.
        matches: matches of each object, in the order of the guess.
    """
    for n, found in enumerate(matches):
        params, _ = best_placement(models, views, params, n, found)
    return params


def best_placement(
    models: ObjectModels, views: ObservedViews, params: SceneParameters, n: int, found: TemplateMatches
) -> tuple[SceneParameters, float]:
    """Move an object to the match with the least photometric loss, or leave it; return the scene and its loss.

    Args:
        models: models of the objects and the table.
        views: images to compare with.
        params: guess of the scene.
        n: index of the object.
        found: its matches, which may be empty.
    """
    own, losses = loss_of(models, views, params), _losses(models, views, params, n, found)
    if losses.min(initial=np.inf) >= own:
        return params, own
    return params.with_pose(n, found.poses[int(losses.argmin())]), float(losses.min())


def _losses(
    models: ObjectModels, views: ObservedViews, params: SceneParameters, n: int, found: TemplateMatches
) -> Float[np.ndarray, "K"]:
    """Return the loss of the guess with an object at each of its matches."""
    return pose_losses(models, views, params, n, found.poses) if len(found.scores) else np.zeros(0)


def count_of_scenes(objects: int) -> int:
    """Return the number of scenes that `SceneAssembly.scenes` yields."""
    return 1 + len(hemisphere(_LIGHTS)) + _KEPT_ROUGH + _KEPT + objects * (objects - 1) // 2 + 1


def without_objects(params: SceneParameters, numbers: Iterable[int]) -> SceneParameters:
    """Return the guess without some of its objects."""
    for n in numbers:
        params = params.with_pose(n, OUT_OF_VIEW)
    return params


class SceneAssembly:
    """Builds scenes from matches.

    Args:
        models: models of the objects and the table.
        rough: images to try all lights in.
        coarse: images to compare the best scenes in.
        matches: matches of each object.
    """

    def __init__(
        self, models: ObjectModels, rough: ObservedViews, coarse: ObservedViews, matches: list[TemplateMatches]
    ) -> None:
        self._models, self._rough, self._coarse, self._sightings = models, rough, coarse, matches

    def scenes(self, start: SceneParameters) -> Iterator[tuple[SceneParameters, float]]:
        """Yield the best scene so far and its loss after each scene that was tried.

        Args:
            start: one scene to begin with. All others begin without objects.
        """
        empty = without_objects(start, range(len(self._sightings)))
        scenes = [start, *(replace(empty, light=light) for light in hemisphere(_LIGHTS))]
        for views, kept in ((self._rough, len(scenes)), (self._rough, _KEPT_ROUGH), (self._coarse, _KEPT)):
            found: list[tuple[SceneParameters, float]] = []
            for params in scenes[:kept]:
                found.append(self._alternated(params, views))
                found.sort(key=lambda pair: pair[1])
                yield found[0]
            scenes = [params for params, _ in found]
        params, loss = found[0]
        for pair in combinations(range(len(self._sightings)), 2):
            params, loss = self._replaced(params, loss, pair)
            yield params, loss
        yield self._alternated(params, self._coarse)

    def quick_scene(self, names: tuple[str, ...]) -> SceneParameters:
        """Return a scene built under few lights, which is enough to decide whether the objects are there."""
        nowhere = Pose.stacked([OUT_OF_VIEW] * len(names))
        empty = SceneParameters(names, nowhere.position, nowhere.quaternion, OVERHEAD, None)
        begun = [self._alternated(replace(empty, light=light), self._rough) for light in hemisphere(_FEW_LIGHTS)]
        params, _ = min(begun, key=lambda pair: pair[1])
        for views in (self._rough, self._coarse):
            params, _ = self._alternated(params, views)
        return params

    def _alternated(self, params: SceneParameters, views: ObservedViews) -> tuple[SceneParameters, float]:
        """Move each object in turn to its best match, then search the light."""
        params = reassign_poses(self._models, views, params, self._sightings)
        params = replace(params, light=search_light(self._models, self._rough, views, params))
        return params, loss_of(self._models, views, params)

    def _replaced(self, params: SceneParameters, loss: float, pair: tuple[int, int]) -> tuple[SceneParameters, float]:
        """Move two objects at once if that is better, trying each of the best places of the first."""
        best, least = params, loss
        first, second = pair
        rest = without_objects(params, pair)
        others, few = self._sightings[second], self._ranking(rest, second)[:_SECOND]
        others = TemplateMatches(others.poses[few], others.scores[few])
        for k in self._best_places(rest, first):
            one = rest.with_pose(first, self._sightings[first].poses[k])
            both, loss = best_placement(self._models, self._coarse, one, second, others)
            if loss < least:
                best, least = both, loss
        return best, least

    def _best_places(self, params: SceneParameters, n: int) -> list[int]:
        """Return the indices of an object's matches that explain the image best, at most one in each place."""
        positions, kept = self._sightings[n].poses.position, []
        for k in self._ranking(params, n).tolist():
            if not kept or np.linalg.norm(positions[kept] - positions[k], axis=1).min() > _APART_M:
                kept.append(k)
            if len(kept) == _PLACES:
                break
        return kept

    def _ranking(self, params: SceneParameters, n: int) -> Int[np.ndarray, "K"]:
        return np.argsort(_losses(self._models, self._coarse, params, n, self._sightings[n]))
