"""Orders to the processes with neural models, and what answers them."""

from __future__ import annotations

from dataclasses import dataclass
from typing import ClassVar

import numpy as np
from jaxtyping import Float, Float32, UInt8

from osfcore.estimation.steps import ContentCheck
from osfcore.geometry.cameras import Camera
from osfcore.geometry.rollouts import Rollouts
from osfcore.geometry.states import SceneState
from osfcore.paper.method import Method


@dataclass(frozen=True, eq=False, slots=True)
class DrawView:
    """One picture for a visitor of the 3D view. Answered by a DrawnView, or by None if a newer order overtook it.

    Attributes:
        key: who wants it; a newer order of the same key overtakes.
        state: objects with fields only.
        camera: from where.
        is_sharp: exact and with depth; otherwise quick.
    """

    key: str
    state: SceneState
    camera: Camera
    is_sharp: bool

    @property
    def patience(self) -> int:
        """Views that move are drawn before comparisons, views that rest after them."""
        return 2 if self.is_sharp else 0


@dataclass(frozen=True, eq=False, slots=True)
class DrawnView:
    """A picture for the 3D view.

    Attributes:
        image: 8-bit RGB.
        depth: along the camera's z axis, 0 where there is nothing [m]; None for a quick picture.
    """

    image: UInt8[np.ndarray, "h w 3"]
    depth: Float32[np.ndarray, "h w"] | None


@dataclass(frozen=True, eq=False, slots=True)
class CompareView:
    """Render what a camera saw, and compare. Answered by a Comparison.

    Attributes:
        key: different for every order, since none is to be left out.
        state: what the camera saw.
        camera: the camera.
        observed: its image, PNG of the camera's size.
    """

    key: str
    state: SceneState
    camera: Camera
    observed: bytes
    patience: ClassVar[int] = 1


@dataclass(frozen=True, slots=True)
class Comparison:
    """A rendering beside what was observed.

    Attributes:
        rendered: PNG.
        difference: absolute, times four; PNG.
        comparison: observed, rendered and difference side by side; PNG.
        psnr_db: over all pixels and colours [dB].
    """

    rendered: bytes
    difference: bytes
    comparison: bytes
    psnr_db: float


@dataclass(frozen=True, eq=False, slots=True)
class DrawPhoto:
    """Render what a photograph of a table shows, as bright as that. Answered by PNG, encoded as sRGB.

    Attributes:
        key: different for every order, since none is to be left out.
        state: what was found.
        camera: that took the photo, perhaps with fewer pixels.
        photo: JPEG.
        masks: PNGs of the photo's size, which together show the objects.
    """

    key: str
    state: SceneState
    camera: Camera
    photo: bytes
    masks: tuple[bytes, ...]
    patience: ClassVar[int] = 1


@dataclass(frozen=True, eq=False, slots=True)
class CheckPhoto:
    """Look whether a photo shows the objects of a scene. Answered by a ContentCheck.

    Attributes:
        key: different for every order, since none is to be left out.
        state: how the objects lie now.
        camera: that took the photo.
        photo: PNG of the camera's size.
    """

    key: str
    state: SceneState
    camera: Camera
    photo: bytes
    patience: ClassVar[int] = 0


@dataclass(frozen=True, eq=False, slots=True)
class PredictPushes:
    """Where sequences of actions would lead. Answered by Predicted, or by None if a newer order overtook it.

    Attributes:
        key: who wants it; a newer order of the same key overtakes.
        state: objects with fields only, and the pusher.
        actions: velocities of the pusher [m/s].
        before: the same objects one action ago, if something may still be moving.
        method: whose model predicts.
    """

    key: str
    state: SceneState
    actions: Float[np.ndarray, "K T 3"]
    before: SceneState | None = None
    method: Method = "ours"


@dataclass(frozen=True, eq=False, slots=True)
class Predicted:
    """A prediction.

    Attributes:
        rollouts: the futures.
        took_s: time that they took, without waiting and without loading [s].
    """

    rollouts: Rollouts
    took_s: float


Order = DrawView | CompareView | DrawPhoto | CheckPhoto | PredictPushes
NeuralAnswer = DrawnView | Comparison | ContentCheck | Predicted | bytes | None
