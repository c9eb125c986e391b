"""Finding an object in one image without a mask: templates slid over the image, under every light at once.

A matte object under any distant light looks nearly like a mixture of its images under four lights. A template is those
four; where it is put, the best mixture is a small least-squares problem. What counts is how much better it explains
its pixels than the bare table does, lit or in shadow.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float, Int

from osfcore.estimation.objective.object_models import QUALITY, ObjectModels
from osfcore.estimation.objective.observed_views import ObservedViews, crop_camera
from osfcore.estimation.objective.parametrization import SceneParameters
from osfcore.estimation.photometry.table_check import lit_table_level
from osfcore.geometry.cameras import Camera
from osfcore.geometry.light import AMBIENT, DIFFUSE
from osfcore.geometry.poses import Pose, rotate
from osfcore.geometry.workspace import TABLE_SIDE_M, WORKSPACE_HALF_M
from osfcore.render.types import SceneBatch

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
    """Where an object may be in an image, the most likely first.

    Attributes:
        positions: of the object's origin [m].
        quaternions: unit.
        scores: by how much each explains its pixels better than the table does.
    """

    positions: Float[np.ndarray, "K 3"]
    quaternions: Float[np.ndarray, "K 4"]
    scores: Float[np.ndarray, "K"]

    @property
    def poses(self) -> Pose:
        """All of them."""
        return Pose(self.positions, self.quaternions)

    def pose(self, number: int) -> Pose:
        """One of them."""
        return Pose(self.positions[number], self.quaternions[number])

    def within(self, position: Float[np.ndarray, "3"], reach: float) -> TemplateMatches:
        """Those within `reach` [m] of a position."""
        return self.subset(np.flatnonzero(np.linalg.norm(self.positions - position, axis=1) < reach))

    def subset(self, numbers: Int[np.ndarray, "C"]) -> TemplateMatches:
        """Some of them."""
        return TemplateMatches(self.positions[numbers], self.quaternions[numbers], self.scores[numbers])


def table_errors(models: ObjectModels, views: ObservedViews, lit: float | None = None) -> Float[np.ndarray, "h w"]:
    """Squared error of the first view's pixels if they show the table.

    Args:
        models: fields.
        views: what was observed.
        lit: light on the lit table, see `lit_table_level`: then each pixel shows that, or shadow. Else it is lit or
            shaded at will, and grey objects pass for table, too.
    """
    view = views.cameras[:1]
    nothing = SceneBatch((), np.zeros((1, 0, 3)), np.zeros((1, 0, 4)), _BASIS[:1], None)
    table = models.together.render(nothing, view, quality=QUALITY).rgb[0, 0]
    image = views.images[0]
    share = (image * table).sum(axis=-1) / np.maximum((table * table).sum(axis=-1), 1e-6)
    errors = np.full(share.shape, _MAX_TABLE_ERROR**2)
    full = AMBIENT + DIFFUSE * (lit or 0)
    for low, high in [(0.2, 1.05)] if lit is None else [(0.2, AMBIENT), ((1 - _UNEVEN) * full, (1 + _UNEVEN) * full)]:
        left = image - table * np.clip(share, low, high)[..., None]
        errors = np.minimum(errors, (left**2).sum(axis=-1))
    return errors


def scene_errors(models: ObjectModels, views: ObservedViews, params: SceneParameters) -> Float[np.ndarray, "h w"]:
    """Squared error of the first view's pixels, summed over the colours and truncated.

    Args:
        models: fields.
        views: what was observed; only the first view counts.
        params: the scene to render, such as the objects found so far.
    """
    rendered = models.together.render(params.perturbed(np.zeros((1, params.size))), views.cameras[:1], quality=QUALITY)
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
    """Look for an object in the first view, in given orientations and at given heights of its origin [m].

    Args:
        models: fields.
        views: what was observed.
        name: of the object.
        quaternions: of the orientations.
        heights: for each of them.
        most: how many matches are kept.
        behind: squared errors of the pixels without the object; those of the table under its own light by default.
        light: unit vector toward the light, where it is known; any light else.
    """
    lights = _BASIS if light is None else light[None]
    camera, image = views.cameras[0], views.images[0]
    table = table_errors(models, views, lit_table_level(models, views)) if behind is None else behind
    grid = np.linspace(-1, 1, 2 * _ANCHORS + 1)[1::2] * _REACH_M
    found = [
        _match_at_anchor(models, camera, image, table, name, quaternions, heights, lights, (x, y))
        for x in grid
        for y in grid
    ]
    positions, turns, scores = (np.concatenate(parts) for parts in zip(*found, strict=True))
    return _non_maximum_suppression(positions, turns, scores, most)


def _match_at_anchor(
    models: ObjectModels,
    camera: Camera,
    image: np.ndarray,
    table: np.ndarray,
    name: str,
    quaternions: np.ndarray,
    heights: np.ndarray,
    lights: np.ndarray,
    anchor: tuple[float, float],
) -> tuple[np.ndarray, ...]:
    """The best places of each orientation around an anchor: positions, orientations, scores."""
    resting = models.resting(name)
    positions = np.column_stack([np.tile(anchor, (len(heights), 1)), heights])
    centre = positions[0] + rotate(quaternions[0], resting.centre)
    nothing = np.zeros((0, 3)), np.zeros((0, 4)), np.zeros(0)
    depth = float(camera.T_world_camera.inverse().apply(centre)[2])
    if depth < resting.radius:
        return nothing  # behind the camera, or around it
    height, width = image.shape[:2]
    per_metre = camera.intrinsics[0, 0] / depth
    half = int(np.clip(np.ceil(1.15 * resting.radius * per_metre) + 1, 8, min(height, width) // 2))
    shift = min(int(np.ceil(_REACH_M / _ANCHORS * per_metre)) + 1, max(height, width) // 2)
    x, y = (int(v) for v in np.round(camera.project(centre)) - half)
    if not (-2 * half < x < width and -2 * half < y < height):
        return nothing  # the camera does not look there
    patches, places = _patches(np.concatenate([image, table[..., None]], axis=-1), x, y, 2 * half, shift)
    scores = _scores(
        models, crop_camera(camera, x, y, 2 * half, 2 * half), name, positions, quaternions, lights, patches
    )
    best = _best_per_block(scores, places, _BLOCK_M * per_metre)
    scores, places = np.take_along_axis(scores, best, axis=0).ravel(), places[best.ravel()]
    quaternions, heights = (np.tile(a, (len(best),) + (1,) * (a.ndim - 1)) for a in (quaternions, heights))
    pixels = np.tile(camera.project(positions), (len(best), 1)) + places
    directions = camera.ray_directions(pixels)
    eye = camera.T_world_camera.position
    far = (heights - eye[2]) / np.minimum(directions[:, 2], -1e-3)
    found = eye + far[:, None] * directions
    on_table = np.abs(found[:, :2]).max(axis=1) < TABLE_SIDE_M / 2  # toward the horizon a pixel is many metres
    return found[on_table], quaternions[on_table], scores[on_table]


def _best_per_block(scores: np.ndarray, places: np.ndarray, side: float) -> Int[np.ndarray, "B K"]:
    """For each square block of shifted windows, and each template, the window where it scores best."""
    blocks = np.floor(places / max(side, 1.0)).astype(int)
    members = [np.flatnonzero((blocks == block).all(axis=1)) for block in np.unique(blocks, axis=0)]
    return np.stack([own[scores[own].argmax(axis=0)] for own in members])


def _patches(image: np.ndarray, x: int, y: int, side: int, shift: int) -> tuple[np.ndarray, np.ndarray]:
    """Windows of an image around one, S x side x side x c, and by how much each is shifted (x, y).

    Beyond the image's border everything is black, and the table explains it.
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
    """How much better each of K templates explains each of S windows than the table does."""
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


def _non_maximum_suppression(
    positions: np.ndarray, quaternions: np.ndarray, scores: np.ndarray, most: int
) -> TemplateMatches:
    """The best ones that differ in place or orientation."""
    order = np.argsort(-scores)
    positions, quaternions, scores = positions[order], quaternions[order], scores[order]
    kept, left = [], np.ones(len(scores), bool)
    while left.any() and len(kept) < most:
        k = int(left.argmax())
        kept.append(k)
        near = np.linalg.norm(positions - positions[k], axis=1) <= _NEAR_M
        left &= ~(near & (np.abs(quaternions @ quaternions[k]) >= np.cos(_NEAR_RAD / 2)))
        left[k] = False
    return TemplateMatches(positions[kept], quaternions[kept], scores[kept])
