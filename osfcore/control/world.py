"""The methods that a tabletop with a pusher must have, so that a robot can replace the simulator."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Literal, Protocol

import numpy as np
from jaxtyping import Float

from osfcore.geometry.cameras import Camera
from osfcore.geometry.states import Observation, SceneState


class World(Protocol):
    """A table with objects, cameras, and one pusher that follows velocities.

    The simulator (`osfcore.world.tabletop.Tabletop`) is one implementation; a real robot can be another. A world
    returns no poses and no depth, so that an episode has to estimate them from images.
    """

    def reset(self, seed: int) -> Observation:
        """Arrange a scene and observe it. In simulation a seed repeats its scene; a robot may ask a person for help."""
        ...

    def observe(self, *, masks: bool = False) -> Observation:
        """Take an image with every camera. With `masks`, add object masks if this world can make them, else None."""
        ...

    def act(self, action: Float[np.ndarray, "3"]) -> None:
        """Move the pusher with velocity (vx, vy, 0) in the world [m/s] for 0.2 s.

        Raises:
            InvalidInput: if the action is outside its limits. The world is then unchanged.
        """
        ...

    def close(self) -> None:
        """Release the resources of the world. Calling it again does nothing."""
        ...


class SimulatedWorld(World, Protocol):
    """A world that also knows the true state. Only reports use it; estimators and planners do not."""

    def truth(self) -> SceneState:
        """Return the true state of the scene."""
        ...

    def render(self, cameras: tuple[Camera, ...], *, masks: bool = False, with_pusher: bool = True) -> Observation:
        """Take an image with each of these cameras."""
        ...


# Observations for the estimators of an episode: without covered cameras, and at the brightness of the first images.
#
# A covered camera shows one colour, and its image would distort every estimate. A lamp that is dimmed makes all of an
# image darker by one factor, lit and shadowed parts alike. A lamp that is moved does not: its shadows keep their
# radiance and lie elsewhere. So a common factor is divided out of the images, and any other change is left to the
# search for the lamp.


_BLIND = 0.015  # standard deviation of an image that shows one colour [radiance]
_FEWEST = 2  # cameras that an estimate needs
_DARKEST = 0.02  # radiance below which a pixel does not count for factors
_CHANGE, _AGREES = 0.1, 0.08  # logarithms: of a factor that counts, and of those that are the same
_ALIKE = 0.6  # share of pixels that must agree
_SHADOWED, _FEW = 0.55, 40  # of the median: pixels in shadow, if there are that many


@dataclass(frozen=True, slots=True)
class SightChange:
    """A change in the images that a person should know about.

    Attributes:
        matter: the kind of change.
        text: the message, one sentence.
    """

    matter: Literal["camera", "brightness"]
    text: str


class Sight:
    """Prepares observations for the estimators, one after the other."""

    def __init__(self) -> None:
        self._brightness = 1.0
        self._blind: frozenset[str] = frozenset()
        self._before: Observation | None = None

    def take(self, observation: Observation) -> tuple[Observation, tuple[SightChange, ...]]:
        """Return an observation as an estimator should receive it, and the changes since the last one."""
        blind = blind_cameras(observation)
        lost, back = sorted(blind - self._blind), sorted(self._blind - blind)
        changes = [SightChange("camera", f"Camera {name} sees nothing; continuing with the others.") for name in lost]
        changes += [SightChange("camera", f"Camera {name} sees again.") for name in back]
        self._blind = blind
        seen = without_cameras(observation, blind)
        factor = None if self._before is None else brightness_change(self._before, seen)
        self._before = seen
        if factor is not None:
            self._brightness *= factor
            share = f"{100 * self._brightness:.0f} %"
            changes.append(SightChange("brightness", f"The light is at {share} of its first brightness."))
        if abs(np.log(self._brightness)) < _CHANGE / 2:
            self._brightness = 1.0
        images = np.clip(seen.images / np.float32(self._brightness), 0, 1)
        return replace(seen, images=images) if self._brightness != 1.0 else seen, tuple(changes)


def blind_cameras(observation: Observation) -> frozenset[str]:
    """Return the names of cameras whose images show a single colour; none if fewer than two others remain."""
    spread = observation.images.std(axis=(1, 2)).max(axis=1)
    names = frozenset(c.name for c, one in zip(observation.cameras, spread, strict=True) if one < _BLIND)
    return names if len(observation.cameras) - len(names) >= _FEWEST else frozenset()


def without_cameras(observation: Observation, names: frozenset[str]) -> Observation:
    """Return an observation without some of its views."""
    kept = [v for v, camera in enumerate(observation.cameras) if camera.name not in names]
    if len(kept) == len(observation.cameras):
        return observation
    masks = None if observation.masks is None else observation.masks[kept]
    cameras = tuple(observation.cameras[v] for v in kept)
    unmasked = None if observation.unmasked is None else observation.unmasked[kept]
    return replace(observation, cameras=cameras, images=observation.images[kept], masks=masks, unmasked=unmasked)


def brightness_change(before: Observation, now: Observation) -> float | None:
    """Return the factor by which all pixels became brighter; None if it is close to 1 or pixels disagree.

    Args:
        before: an observation.
        now: a later observation. Cameras that both have are compared.
    """
    views = [(a, b) for a, x in enumerate(before.cameras) for b, y in enumerate(now.cameras) if x.name == y.name]
    if not views:
        return None
    images = before.images[[a for a, _ in views]], now.images[[b for _, b in views]]
    old, new = (image.mean(axis=-1).ravel().astype(float) for image in images)
    usable = (old > _DARKEST) & (new > _DARKEST / 4)
    if usable.sum() < _FEW:
        return None
    ratio = np.log(new[usable] / old[usable])
    change = float(np.median(ratio))
    shadowed = ratio[old[usable] < _SHADOWED * np.median(old[usable])]
    is_common = len(shadowed) < _FEW or abs(float(np.median(shadowed)) - change) < _AGREES
    is_alike = np.mean(np.abs(ratio - change) < _AGREES) > _ALIKE
    return float(np.exp(change)) if abs(change) > _CHANGE and is_common and is_alike else None
