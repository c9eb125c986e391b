"""Scenes put together from matches: which of them explain an image together, its light being unknown.

Objects and light depend on each other: under a wrong light a wrong scene may look right. So it is begun under lights
all over the hemisphere, on rough images, and the best of these scenes are sorted out on finer ones. Last, objects are
replaced two at a time: one that stands in another's place keeps it from there.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from dataclasses import replace
from itertools import combinations

import numpy as np
from jaxtyping import Float, Int

from osfcore.estimation.hypotheses.orientation_hypotheses import pose_losses, with_pose
from osfcore.estimation.hypotheses.template_matching import TemplateMatches
from osfcore.estimation.objective.object_models import ObjectModels
from osfcore.estimation.objective.observed_views import ObservedViews
from osfcore.estimation.objective.parametrization import SceneParameters
from osfcore.estimation.objective.photometric_loss import loss_of
from osfcore.estimation.search.light_search import hemisphere, search_light
from osfcore.geometry.poses import Pose

OUT_OF_VIEW = Pose(np.array([0.0, 0.0, -1.0]), np.array([1.0, 0.0, 0.0, 0.0]))  # below the table: not in the image
_LIGHTS = 40  # over the whole sphere, to begin with
_FEW_LIGHTS = 10
_KEPT_ROUGH, _KEPT = 8, 3  # of the scenes found under them, for another round, and for one on finer images
_PLACES, _APART_M, _SECOND = 8, 0.03, 40  # places tried for the first of two objects, matches for the second


def assemble_scene(
    models: ObjectModels,
    rough: ObservedViews,
    coarse: ObservedViews,
    start: SceneParameters,
    matches: list[TemplateMatches],
) -> Iterator[tuple[SceneParameters, float]]:
    """Put scenes together; yields the best so far and its loss, each time one more was tried.

    Args:
        models: fields.
        rough: images for all lights.
        coarse: images for the best of them.
        start: one scene to begin with; the others begin with no object.
        matches: of each object.
    """
    yield from _SceneAssembly(models, rough, coarse, matches).scenes(start)


def quick_scene(
    models: ObjectModels,
    rough: ObservedViews,
    coarse: ObservedViews,
    names: tuple[str, ...],
    matches: list[TemplateMatches],
) -> SceneParameters:
    """A scene put together under few lights, good enough to tell whether the objects are there at all.

    Args:
        models: fields.
        rough: images for all lights.
        coarse: images for the best of them.
        names: of the objects.
        matches: of each object.
    """
    nowhere, unturned = (np.tile(part, (len(names), 1)) for part in (OUT_OF_VIEW.position, OUT_OF_VIEW.quaternion))
    empty = SceneParameters(names, nowhere, unturned, np.array([0.0, 0.0, 1.0]), None)
    return _SceneAssembly(models, rough, coarse, matches).quick_scene(empty)


def reassign_poses(
    models: ObjectModels, views: ObservedViews, params: SceneParameters, matches: list[TemplateMatches]
) -> SceneParameters:
    """In turn each object at the match that explains whole images better than its pose does; the same if none.

    Args:
        models: fields.
        views: images to compare with.
        params: the guess.
        matches: of each object, in the guess's order.
    """
    for n, found in enumerate(matches):
        params, _ = best_placement(models, views, params, n, found)
    return params


def best_placement(
    models: ObjectModels, views: ObservedViews, params: SceneParameters, n: int, found: TemplateMatches
) -> tuple[SceneParameters, float]:
    """The guess with an object where its photometric loss is least, where it is or at a match; and that loss.

    Args:
        models: fields.
        views: images to compare with.
        params: the guess.
        n: number of the object.
        found: its matches, perhaps none.
    """
    own, losses = loss_of(models, views, params), _losses(models, views, params, n, found)
    if losses.min(initial=np.inf) >= own:
        return params, own
    return with_pose(params, n, found.pose(int(losses.argmin()))), float(losses.min())


def _losses(
    models: ObjectModels, views: ObservedViews, params: SceneParameters, n: int, found: TemplateMatches
) -> Float[np.ndarray, "K"]:
    """Loss of the guess with an object at each of its matches."""
    return pose_losses(models, views, params, n, found.poses) if len(found.scores) else np.zeros(0)


def count_of_scenes(objects: int) -> int:
    """How many steps it takes."""
    return 1 + len(hemisphere(_LIGHTS)) + _KEPT_ROUGH + _KEPT + objects * (objects - 1) // 2 + 1


def without_objects(params: SceneParameters, numbers: Iterable[int]) -> SceneParameters:
    """The guess with some objects away."""
    for n in numbers:
        params = with_pose(params, n, OUT_OF_VIEW)
    return params


class _SceneAssembly:
    def __init__(
        self, models: ObjectModels, rough: ObservedViews, coarse: ObservedViews, matches: list[TemplateMatches]
    ) -> None:
        self._models, self._rough, self._coarse, self._sightings = models, rough, coarse, matches

    def scenes(self, start: SceneParameters) -> Iterator[tuple[SceneParameters, float]]:
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

    def quick_scene(self, empty: SceneParameters) -> SceneParameters:
        begun = [self._alternated(replace(empty, light=light), self._rough) for light in hemisphere(_FEW_LIGHTS)]
        params, _ = min(begun, key=lambda pair: pair[1])
        for views in (self._rough, self._coarse):
            params, _ = self._alternated(params, views)
        return params

    def _alternated(self, params: SceneParameters, views: ObservedViews) -> tuple[SceneParameters, float]:
        """In turn each object at its best match, and the light."""
        for n, found in enumerate(self._sightings):
            params, _ = best_placement(self._models, views, params, n, found)
        params = replace(params, light=search_light(self._models, self._rough, views, params))
        return params, loss_of(self._models, views, params)

    def _replaced(self, params: SceneParameters, loss: float, pair: tuple[int, int]) -> tuple[SceneParameters, float]:
        """Take two objects away and put them elsewhere, the first in each of its best places, if that is better."""
        best, least = params, loss
        first, second = pair
        rest = without_objects(params, pair)
        others = self._sightings[second]
        others = others.subset(self._ranking(rest, second)[:_SECOND])
        for k in self._best_places(rest, first):
            one = with_pose(rest, first, self._sightings[first].pose(k))
            both, loss = best_placement(self._models, self._coarse, one, second, others)
            if loss < least:
                best, least = both, loss
        return best, least

    def _best_places(self, params: SceneParameters, n: int) -> list[int]:
        """Numbers of the matches of an object that explain the image best, each in a place of its own."""
        positions, kept = self._sightings[n].positions, []
        for k in self._ranking(params, n).tolist():
            if not kept or np.linalg.norm(positions[kept] - positions[k], axis=1).min() > _APART_M:
                kept.append(k)
            if len(kept) == _PLACES:
                break
        return kept

    def _ranking(self, params: SceneParameters, n: int) -> Int[np.ndarray, "K"]:
        return np.argsort(_losses(self._models, self._coarse, params, n, self._sightings[n]))
