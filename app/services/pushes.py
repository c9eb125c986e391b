"""Pushes as people think of them: a way to go at some speed, and what came of it."""

from __future__ import annotations

import uuid
from collections.abc import Callable, Collection
from concurrent.futures import Future
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float

from app.processes.client import ProcessClient
from app.processes.messages.neural_messages import NeuralAnswer, PredictPushes
from app.processes.messages.scene_messages import SceneRecord
from app.services.estimates import errors_of
from app.services.fields import MissingFields
from app.services.scenes import Scenes, scene_or_current
from osfcore.errors import InvalidInput, OsfError
from osfcore.geometry.poses import Pose
from osfcore.geometry.rollouts import Rollouts, check_actions
from osfcore.geometry.states import SceneState
from osfcore.geometry.workspace import MAX_SPEED_M_S, PUSHER_REACH_M, STEP_S
from osfcore.objects.asset_library import AssetLibrary
from osfcore.paper.method import Method

MAX_ACTIONS = 50
_STILL_M = 1e-9
_BEYOND_M = 0.05


def toward(start: Float[np.ndarray, "2"], target: Float[np.ndarray, "2"], speed_m_s: float) -> Float[np.ndarray, "T 3"]:
    """Return equal actions [m/s] that lead straight from one place to another, as few as it takes.

    Args:
        start: where the pusher is [m].
        target: where it is to go [m]; what is beyond its reach is brought back to the edge.
        speed_m_s: not to be exceeded, nor are 0.3 m/s on an axis.

    Raises:
        InvalidInput: if the way is empty, not finite or takes more than 50 actions.
    """
    if not np.all(np.isfinite(target)):
        raise InvalidInput("place to push to [m]", target.tolist(), "finite")
    way = np.clip(target, -PUSHER_REACH_M, PUSHER_REACH_M) - start
    least_s = max(float(np.linalg.norm(way)) / speed_m_s, float(np.abs(way).max()) / MAX_SPEED_M_S)
    count = int(np.ceil(least_s / STEP_S - 1e-9))
    if not 1 <= count <= MAX_ACTIONS:
        raise InvalidInput("number of actions on this way", count, f"between 1 and {MAX_ACTIONS}")
    velocity = np.clip(way / (count * STEP_S), -MAX_SPEED_M_S, MAX_SPEED_M_S)
    return np.tile([*velocity, 0.0], (count, 1))


def beyond_nearest(state: SceneState) -> Float[np.ndarray, "2"] | None:
    """Return the point 5 cm beyond the middle of the object nearest to the pusher [m]; None without the two."""
    if state.pusher is None or not state.names:
        return None
    ways = state.poses.position[:, :2] - state.pusher[:2]
    nearest = ways[int(np.linalg.norm(ways, axis=1).argmin())]
    return state.pusher[:2] + nearest * (1 + _BEYOND_M / max(float(np.linalg.norm(nearest)), _STILL_M))


@dataclass(frozen=True, slots=True)
class Outcome:
    """What a push did to one object.

    Attributes:
        name: of the object.
        predicted_mm: how far it was predicted to go.
        predicted_deg: how far it was predicted to turn.
        went_mm: how far it went; None before it was tried, like all that follows.
        turned_deg: how far it turned.
        off_mm: between where it was predicted and where it is.
        off_deg: likewise, between orientations that look different.
    """

    name: str
    predicted_mm: float
    predicted_deg: float
    went_mm: float | None = None
    turned_deg: float | None = None
    off_mm: float | None = None
    off_deg: float | None = None


def outcomes(
    before: SceneState, rollouts: Rollouts, after: SceneState | None, library: AssetLibrary
) -> tuple[Outcome, ...]:
    """The first of some rollouts, against the truth if it is known, object by object.

    Args:
        before: the start.
        rollouts: what was predicted.
        after: what the simulator made of it; None before it was tried.
        library: knows which rotations of an object look alike.
    """
    end = Pose(rollouts.positions[0, -1], rollouts.quaternions[0, -1])
    predicted = SceneState(rollouts.names, end, before.light, before.pusher)
    columns = [errors_of(predicted, before, library)["objects"]]
    if after is not None:
        columns += [errors_of(after, before, library)["objects"], errors_of(predicted, after, library)["objects"]]
    errors = [{entry["name"]: (entry["position_mm"], entry["rotation_deg"]) for entry in column} for column in columns]
    return tuple(Outcome(name, *(value for column in errors for value in column[name])) for name in rollouts.names)


# Predictions of what pushes do: checked here, made in a process of their own (`app.processes.predict_process`)


class NothingToPush(OsfError):
    """There is no scene from which a prediction could start."""

    def __init__(self) -> None:
        super().__init__("There is no scene to predict; make one, or send a state.")


class Predictions:
    """Asks for predictions. Any thread may call.

    Args:
        scenes: of the service.
        fields: names of the objects that have a field, from which their shape is known.
        link: to the process that predicts.
    """

    def __init__(self, scenes: Scenes, fields: Callable[[], Collection[str]], link: ProcessClient) -> None:
        self._scenes, self._fields, self._link = scenes, fields, link

    @property
    def is_warm(self) -> bool:
        """Whether the process that predicts has loaded its libraries; the first prediction waits for them."""
        return self._link.is_warm

    def current(self) -> SceneRecord:
        """The scene on the table, from whose true poses predictions start.

        Raises:
            NothingToPush: if there is none.
        """
        return scene_or_current(self._scenes, None, NothingToPush)

    def submit(
        self,
        state: SceneState,
        actions: Float[np.ndarray, "K T 3"],
        key: str | None = None,
        before: SceneState | None = None,
        method: Method = "ours",
    ) -> Future[NeuralAnswer]:
        """Ask where actions would lead; the future brings a Predicted, or None where a newer order of the key overtook.

        Args:
            state: of the scene, with its pusher.
            actions: velocities of the pusher [m/s].
            key: of who asks, if only the latest question of theirs counts.
            before: the same objects one action ago, if something may still be moving.
            method: whose model predicts.

        Raises:
            InvalidInput: if there are no objects or no pusher, other objects before, or actions are out of range.
            MissingFields: if objects have no field.
        """
        actions = check_actions(actions)
        if not state.names:
            raise InvalidInput("number of objects", 0, "at least 1")
        if state.pusher is None:
            raise InvalidInput("pusher of the state", "missing", "given: predictions start from where it is")
        if before is not None and set(before.names) != set(state.names):
            raise InvalidInput("objects one action ago", ", ".join(before.names), "those of the state")
        known = self._fields()
        if missing := [name for name in state.names if name not in known]:
            raise MissingFields(missing)
        return self._link.submit(PredictPushes(key or uuid.uuid4().hex, state, actions, before, method))
