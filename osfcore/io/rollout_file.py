"""actions.json and rollouts.json: what to try, and what would come of it.

actions.json   {"actions": K x T x 3 [m/s], "step_s": 0.2}
rollouts.json  {"names": [N], "positions": K x (T+1) x N x 3 [m], "quaternions": K x (T+1) x N x 4,
"pusher": K x (T+1) x 3 [m], "step_s": 0.2}
"""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float

from osfcore.errors import InvalidInput
from osfcore.geometry.rollouts import Rollouts, check_actions
from osfcore.geometry.workspace import STEP_S
from osfcore.io.files import read_json, write_json
from osfcore.io.json_codec import Entry, Vector3, Vector4, decode

_DIGITS = 9  # nanometres


class _Actions(Entry):
    actions: Any  # `check_actions` says it better
    step_s: float = STEP_S


def actions_from_json(data: object) -> Float[np.ndarray, "K T 3"]:
    """The sequences of actions of parsed JSON [m/s].

    Raises:
        InvalidInput: if something is missing or out of range; the message names it.
    """
    entry = decode(_Actions, data, "the actions file")
    if entry.step_s != STEP_S:
        raise InvalidInput("step_s", entry.step_s, f"{STEP_S}: every action is held that long")
    return check_actions(entry.actions)


def read_actions(path: Path) -> Float[np.ndarray, "K T 3"]:
    """The sequences of actions in a file [m/s].

    Raises:
        CorruptFile: if it cannot be read or holds no actions within the limits; the message says why.
    """
    return read_json(path, actions_from_json)


def rollouts_to_json(rollouts: Rollouts) -> dict[str, Any]:
    """Rollouts as plain lists and numbers."""
    arrays = {key: np.round(getattr(rollouts, key), _DIGITS).tolist() for key in ("positions", "quaternions", "pusher")}
    return {"names": list(rollouts.names), **arrays, "step_s": STEP_S}


class _Rollouts(Entry):
    names: list[str]
    positions: list[list[list[Vector3]]]
    quaternions: list[list[list[Vector4]]]
    pusher: list[list[Vector3]]


def rollouts_from_json(data: object) -> Rollouts:
    """The rollouts of parsed JSON.

    Raises:
        InvalidInput: if something is missing or not a number; the message names it.
    """
    entry = decode(_Rollouts, data, "the rollouts")
    arrays = (np.array(part, float) for part in (entry.positions, entry.quaternions, entry.pusher))
    return Rollouts(tuple(entry.names), *arrays)


def write_rollouts(path: Path, rollouts: Rollouts) -> None:
    """Write rollouts; the file appears only when it is whole.

    Raises:
        CannotWrite: if the disk refuses.
    """
    write_json(path, rollouts_to_json(rollouts))
