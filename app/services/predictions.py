"""Predictions of what pushes do: checked here, made in a process of their own (`app.processes.predict_process`)."""

from __future__ import annotations

import uuid
from collections.abc import Callable, Collection
from concurrent.futures import Future

import numpy as np
from jaxtyping import Float

from app.processes.client import ProcessClient
from app.processes.messages.neural_messages import NeuralAnswer, PredictPushes
from app.processes.messages.scene_messages import SceneRecord
from app.services.fields import MissingFields
from app.services.runner import Runner
from osfcore.errors import InvalidInput, OsfError
from osfcore.geometry.rollouts import check_actions
from osfcore.geometry.states import SceneState
from osfcore.paper.method import Method


class NothingToPush(OsfError):
    """There is no scene from which a prediction could start."""

    def __init__(self) -> None:
        super().__init__("There is no scene to predict; make one, or send a state.")


class Predictions:
    """Asks for predictions. Any thread may call.

    Args:
        runner: knows the scenes.
        fields: names of the objects that have a field, from which their shape is known.
        link: to the process that predicts.
    """

    def __init__(self, runner: Runner, fields: Callable[[], Collection[str]], link: ProcessClient) -> None:
        self._runner = runner
        self._fields = fields
        self._link = link

    @property
    def is_warm(self) -> bool:
        """Whether the process that predicts has loaded its libraries; the first prediction waits for them."""
        return self._link.is_warm

    def current(self) -> SceneRecord:
        """The scene on the table, from whose true poses predictions start.

        Raises:
            NothingToPush: if there is none.
        """
        current = self._runner.current
        if current is None:
            raise NothingToPush
        return self._runner.scene(current)

    def submit(
        self,
        state: SceneState,
        actions: Float[np.ndarray, "K T 3"],
        key: str | None = None,
        before: SceneState | None = None,
        method: Method = "ours",
    ) -> Future[NeuralAnswer]:
        """Ask where actions would lead; the future tells a Predicted, or None where a newer order of the key overtook.

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
        missing = [name for name in state.names if name not in known]
        if missing:
            raise MissingFields(missing)
        return self._link.submit(PredictPushes(key or uuid.uuid4().hex, state, actions, before, method))
