"""Pushes as people think of them: a way to go at some speed, what is predicted of it, and what came of it."""

from __future__ import annotations

import logging
import threading
import uuid
from collections.abc import Callable, Collection, Sequence
from concurrent.futures import Future
from dataclasses import dataclass, replace
from functools import partial
from typing import Literal

import numpy as np
from jaxtyping import Float

from osfcore.errors import InvalidInput, OsfError
from osfcore.geometry.poses import Pose
from osfcore.geometry.rollouts import Rollouts, check_actions
from osfcore.geometry.states import SceneState
from osfcore.geometry.workspace import MAX_SPEED_M_S, PUSHER_REACH_M, STEP_S
from osfcore.objects.asset_library import AssetLibrary
from osfcore.paper.method import Method

from ..processes.client import ProcessClient
from ..processes.messages.neural_messages import NeuralAnswer, Predicted, PredictPushes
from ..processes.messages.scene_messages import SceneChanged, SceneRecord
from .estimates import errors_of
from .event_hub import CurrentScene, Hub
from .fields import MissingFields
from .scenes import Scenes, scene_or_current

MAX_ACTIONS = 50
SPEED_M_S = 0.25  # of a push, unless another is asked for
_STILL_M = 1e-9
_BEYOND_M = 0.05
_KEY = "push"
PushState = Literal["predicting", "predicted", "executing", "executed", "refused", "outdated"]
_CHANGED = "The table has changed; predict again."
_log = logging.getLogger(__name__)


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
    """There is no scene from which a prediction could start, or nothing in it."""

    def __init__(self, why: str = "There is no scene to predict; make one, or send a state.") -> None:
        super().__init__(why)


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
            raise InvalidInput("pusher of the state", "missing", "given, because predictions start from it")
        if before is not None and set(before.names) != set(state.names):
            raise InvalidInput("objects one action ago", ", ".join(before.names), "those of the state")
        known = self._fields()
        if missing := [name for name in state.names if name not in known]:
            raise MissingFields(missing)
        return self._link.submit(PredictPushes(key or uuid.uuid4().hex, state, actions, before, method))


# The push that somebody tries


class NoPush(OsfError):
    """No push is chosen."""

    def __init__(self) -> None:
        super().__init__("No push is chosen; drag the pusher at an object first.")


class CannotExecute(OsfError):
    """Actions that may not be executed now."""


@dataclass(frozen=True, eq=False, slots=True)
class Push:
    """A push that somebody has chosen, the same for all visitors.

    Attributes:
        record: the scene from which it starts.
        actions: equal velocities of the pusher [m/s].
        state: how far it is; "outdated" once the table has changed otherwise.
        problem: why there is no prediction; empty if there is one, or will be.
        rollouts: what the actions were predicted to lead to.
        took_s: time that predicting took [s].
        truth: the way things truly went, as far as it has been executed.
    """

    record: SceneRecord
    actions: Float[np.ndarray, "T 3"]
    state: PushState = "predicting"
    problem: str = ""
    rollouts: Rollouts | None = None
    took_s: float = 0.0
    truth: tuple[SceneState, ...] = ()

    @property
    def way(self) -> Float[np.ndarray, "2 2"]:
        """Where the pusher starts and ends [m]."""
        assert self.record.state.pusher is not None
        start = self.record.state.pusher[:2]
        return np.stack([start, start + STEP_S * self.actions[:, :2].sum(axis=0)])

    def outcomes(self, library: AssetLibrary) -> tuple[Outcome, ...]:
        """What it does to each object, against the truth once it is executed; empty before it is predicted."""
        if self.rollouts is None:
            return ()
        after = self.truth[-1] if self.state == "executed" else None
        return outcomes(self.record.state, self.rollouts, after, library)

    def after(self, record: SceneRecord, states: Sequence[SceneState] = ()) -> Push:
        """Make the push after a change: it outlives the execution of its own actions, and nothing else.

        Args:
            record: the scene after the change; the simulation counts actions as revisions.
            states: the way there.
        """
        last = self.record.revision + len(self.actions)
        if record.revision <= self.record.revision or (self.state == "executed" and record.revision == last):
            return self
        if self.state == "executing" and record.revision <= last:
            truth = (*(self.truth or (self.record.state,)), *states, record.state)
            return replace(self, truth=truth, state="executed" if record.revision == last else "executing")
        return self.without_prediction("outdated", _CHANGED)

    def without_prediction(self, state: PushState, problem: str) -> Push:
        """Make the push of which nothing is to be drawn, for a reason."""
        return Push(self.record, self.actions, state, problem)


@dataclass(frozen=True, eq=False, slots=True)
class PushChanged:
    """This push is tried now; None if none is."""

    push: Push | None


class Pushes:
    """The push that is tried on the current table. Any thread may call.

    Args:
        scenes: executes actions.
        predictions: predicts pushes.
        hub: tells of changes of the table, and is told of those of the push.
    """

    def __init__(self, scenes: Scenes, predictions: Predictions, hub: Hub) -> None:
        self._scenes, self._predictions, self._hub = scenes, predictions, hub
        self._lock = threading.RLock()  # whoever holds it must not call `scenes`, which publishes under its own
        self._push: Push | None = None
        hub.subscribe(self._hear)

    @property
    def current(self) -> Push | None:
        """The push that is tried; None if none is."""
        return self._push

    @property
    def is_warm(self) -> bool:
        """Whether the network is loaded; the first prediction waits for it."""
        return self._predictions.is_warm

    def predict(self, target: Float[np.ndarray, "2"] | None = None, speed_m_s: float = SPEED_M_S) -> Push:
        """Choose a push from where the pusher is, and ask what it would do; the answer is published.

        Args:
            target: where the pusher is to go [m]; None for just beyond the nearest object.
            speed_m_s: not to be exceeded.

        Raises:
            InvalidInput: if the way is empty or takes too many actions.
            NothingToPush: if there is no scene, no pusher or no object.
            MissingFields: if objects have no field.
            CannotExecute: if one is being executed.
        """
        record = self._predictions.current()
        target = beyond_nearest(record.state) if target is None else target
        if record.state.pusher is None or target is None:
            raise NothingToPush("There is nothing to push on this table; put an object on it.")
        push = Push(record, toward(record.state.pusher[:2], target, speed_m_s))
        with self._lock:
            if self._push is not None and self._push.state == "executing":
                raise CannotExecute("A push is being carried out; wait for its end.")
            self._set(push)
        try:
            answer = self._predictions.submit(record.state, push.actions[None], _KEY)
        except OsfError:
            self._replace(push, None)
            raise
        answer.add_done_callback(partial(self._take, push))
        return push

    def execute(self) -> Push | None:
        """Carry out the push that was predicted; returns it with what came of it, if nothing else has happened since.

        Raises:
            CannotExecute: if none is predicted that is still to be tried.
            SceneHeld: if a job holds the scene.
        """
        with self._lock:
            push = self._push
            if push is None or push.state != "predicted":
                raise CannotExecute("There is no new prediction to execute; drag the pusher first.")
            self._set(replace(push, state="executing"))
        try:
            self._scenes.act(push.record.id, list(push.actions))
        finally:
            with self._lock:
                now = self._push
                if now is not None and now.state == "executing":  # refused, or ended halfway
                    self._set(now.without_prediction("outdated", _CHANGED) if now.truth else push)
        return self._push

    def drop(self) -> None:
        """Forget the push; what is being executed goes on."""
        with self._lock:
            if self._push is not None:
                self._set(None)

    def _take(self, push: Push, answer: Future[NeuralAnswer]) -> None:
        """Take the answer to a push, unless another was chosen or the table has changed meanwhile."""
        try:
            predicted = answer.result()
        except OsfError as error:
            self._replace(push, push.without_prediction("refused", str(error)))
        except Exception:
            _log.exception("a push could not be predicted")
            self._replace(push, push.without_prediction("refused", "The prediction failed; the log has more."))
        else:
            if isinstance(predicted, Predicted):  # else overtaken by a newer request
                known = replace(push, state="predicted", rollouts=predicted.rollouts, took_s=predicted.took_s)
                self._replace(push, known)

    def _hear(self, event: object) -> None:
        with self._lock:
            push = self._push
            match event:
                case CurrentScene() if push is not None:
                    self._set(None)
                case SceneChanged(record, states) if push is not None and record.id == push.record.id:
                    if push.state not in ("refused", "outdated"):
                        self._replace(push, push.after(record, states))

    def _replace(self, before: Push, after: Push | None) -> None:
        with self._lock:
            if self._push is before and after is not before:
                self._set(after)

    def _set(self, push: Push | None) -> None:
        self._push = push
        self._hub.publish(PushChanged(push))
