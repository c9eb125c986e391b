"""What an estimator believes: a scene state, how sure it is, and whether to act on it."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from jaxtyping import Float

from osfcore.errors import InvalidInput
from osfcore.geometry.states import SceneState


@dataclass(frozen=True, eq=False, slots=True)
class EstimatedState:
    """A scene state with its uncertainty.

    Attributes:
        state: the most likely state.
        position_std: standard deviation of each object's position, per axis [m].
        rotation_std: of each object's orientation, per axis of a small rotation [rad].
        light_std: of the direction toward the light, per axis [rad].
        doubts: for each object why it should not be trusted; "" where it may be.
        reason: why the whole should not be trusted, in a sentence; "" where it may be.
    """

    state: SceneState
    position_std: Float[np.ndarray, "N"]
    rotation_std: Float[np.ndarray, "N"]
    light_std: float
    doubts: tuple[str, ...]
    reason: str

    def __post_init__(self) -> None:
        """Check shapes and signs."""
        count = len(self.state.names)
        for name in ("position_std", "rotation_std"):
            array = getattr(self, name)
            if array.shape != (count,) or not np.all(array >= 0):  # also false for NaN
                raise InvalidInput(name, array.tolist(), f"{count} numbers of at least 0")
        if not self.light_std >= 0:
            raise InvalidInput("light_std", self.light_std, "a number of at least 0")
        if len(self.doubts) != count:
            raise InvalidInput("doubts", len(self.doubts), f"one for each of {count} objects")

    @property
    def trusted(self) -> bool:
        """Whether to act on it."""
        return not self.reason

    @property
    def doubted(self) -> tuple[str, ...]:
        """Objects that should not be trusted."""
        return tuple(name for name, doubt in zip(self.state.names, self.doubts, strict=True) if doubt)

    def with_pusher(self, pusher: Float[np.ndarray, "3"] | None) -> EstimatedState:
        """The same with the pusher where the robot says it is: it knows its hand [m]."""
        return replace(self, state=replace(self.state, pusher=pusher))
