"""Sequences of actions, and the futures predicted from them."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float

from osfcore.errors import InvalidInput, check_ranges, shown
from osfcore.geometry.workspace import ACTION_ALLOWED, MAX_SPEED_M_S

MAX_HORIZON = 200
MAX_SEQUENCES = 20_000


@dataclass(frozen=True, eq=False, slots=True)
class Rollouts:
    """Predicted futures of one scene under K sequences of T actions.

    The second axis of the arrays is time. It has T1 = T + 1 entries: before the first action and after each action.

    Attributes:
        names: names of the N objects.
        positions: positions of the objects in the world [m].
        quaternions: orientations of the objects in the world, (w, x, y, z).
        pusher: centre of the pusher in the world [m].

    Example:
        >>> futures = push_model.rollout(state, np.zeros((2, 5, 3)))  # two sequences of five actions that wait
        >>> futures.positions.shape, futures[0].after(3).positions.shape
        ((2, 6, 1, 3), (1, 3, 1, 3))
    """

    names: tuple[str, ...]
    positions: Float[np.ndarray, "K T1 N 3"]
    quaternions: Float[np.ndarray, "K T1 N 4"]
    pusher: Float[np.ndarray, "K T1 3"]

    def __getitem__(self, sequence: int) -> Rollouts:
        """Return one future alone, with K = 1."""
        k = slice(sequence, sequence + 1)
        return Rollouts(self.names, self.positions[k], self.quaternions[k], self.pusher[k])

    @staticmethod
    def joined(parts: Sequence[Rollouts]) -> Rollouts:
        """Join futures of the same scene along the first axis."""
        positions, quaternions, pusher = (
            np.concatenate([getattr(part, name) for part in parts]) for name in ("positions", "quaternions", "pusher")
        )
        return Rollouts(parts[0].names, positions, quaternions, pusher)

    def after(self, actions: int) -> Rollouts:
        """Return the futures from the given number of actions on. The last state is always kept."""
        t = slice(min(actions, self.positions.shape[1] - 1), None)
        return Rollouts(self.names, self.positions[:, t], self.quaternions[:, t], self.pusher[:, t])


def check_actions(actions: object) -> Float[np.ndarray, "K T 3"]:
    """Return sequences of actions after checking that they can be rolled out.

    Raises:
        InvalidInput: if they are not K x T x 3 finite numbers within the limits; the message names the first one.
    """
    allowed = f"K x T x 3 numbers, K up to {MAX_SEQUENCES} and T from 1 to {MAX_HORIZON}"
    try:
        array = np.array(actions, dtype=float)
    except (TypeError, ValueError, OverflowError):
        raise InvalidInput("actions [m/s]", shown(actions), allowed) from None
    if array.ndim != 3 or array.shape[2] != 3:
        raise InvalidInput("shape of the actions", array.shape, allowed)
    check_ranges(("horizon [actions]", array.shape[1], 1, MAX_HORIZON))
    check_ranges(("number of action sequences", len(array), 1, MAX_SEQUENCES))
    is_sane = (np.abs(array) <= MAX_SPEED_M_S + 1e-9).all(axis=2) & (array[..., 2] == 0)  # false for NaN, too
    if not is_sane.all():
        k, t = np.argwhere(~is_sane)[0]
        raise InvalidInput(f"action {t} of sequence {k} [m/s]", array[k, t].tolist(), ACTION_ALLOWED)
    return array
