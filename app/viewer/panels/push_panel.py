"""Predicted pushes in the 3D view: the folder in the panel, and the thread that draws them and compares with the truth.

What comes from browsers, the simulation and the process that predicts is only stored; drawing happens in the thread.
"""

from __future__ import annotations

from collections.abc import Callable
from concurrent.futures import Future
from dataclasses import dataclass
from functools import partial

import numpy as np
import viser
from jaxtyping import Float

from app.processes.messages.neural_messages import NeuralAnswer, Predicted
from app.processes.messages.scene_messages import SceneChanged, SceneRecord
from app.services.event_hub import CurrentScene
from app.services.predictions import Predictions
from app.services.pushes import outcomes
from app.viewer.nodes.push_nodes import PushNodes
from app.viewer.nodes.scene_nodes import Client
from app.viewer.panels.panel import Panel, RunCommand, status
from app.viewer.panels.push_controls import PushControls
from app.viewer.panels.push_player import TICK_S, PushPlayer
from app.viewer.panels.push_prediction import PushPrediction, report
from osfcore.errors import OsfError
from osfcore.geometry.workspace import STEP_S
from osfcore.objects.asset_library import AssetLibrary

_KEY = "viewer"
_INTRO = "Starts from the **true poses** in the simulator."
_IDLE = "Choose a push, then Predict"
_EXECUTED = "Executed. Purple: predicted; black: the true ways"
_CHANGED = "The table has changed; predict again"
Act = Callable[[str, list[np.ndarray]], SceneRecord]


class CannotExecute(OsfError):
    """Actions that may not be executed now."""


@dataclass(frozen=True, eq=False, slots=True)
class _Request:
    """A requested prediction and, once it is there, its answer."""

    record: SceneRecord
    actions: Float[np.ndarray, "T 3"]
    client: Client
    answer: Future[NeuralAnswer]


class PushPanel(Panel):
    """The folder and the nodes of predicted pushes; the same in all browsers.

    Args:
        server: whose panel gets the folder.
        library: meshes, symmetries and labels of the objects.
        predictions: predicts pushes.
        act: executes actions in a scene and returns the scene afterwards.
        run_command: carries out a command and notifies its client if it is refused.
    """

    def __init__(
        self,
        server: viser.ViserServer,
        library: AssetLibrary,
        predictions: Predictions,
        act: Act,
        run_command: RunCommand,
    ) -> None:
        super().__init__("push-panel", TICK_S)
        self._library = library
        self._predictions = predictions
        self._act = act
        self._run_command = run_command
        self._nodes = PushNodes(server, library)
        self._record: SceneRecord | None = None
        self._prediction: PushPrediction | None = None
        self._drawn: PushPrediction | None = None
        self._answered: _Request | None = None
        self._message = _IDLE
        self._executing: PushPrediction | None = None
        self._has_plan = False  # whether anybody has begun to choose a push
        self._add_panel(server)

    def _store(self, event: object) -> bool:
        match event:
            case CurrentScene(record):
                self._record, self._prediction, self._message = record, None, _IDLE
            case SceneChanged(record, states) if self._record is not None and record.id == self._record.id:
                self._record = record
                if self._prediction is not None:
                    self._prediction = self._prediction.after(record, states, self._executing)
                    self._message = _CHANGED if self._prediction is None else self._message
            case _:
                return False
        return True

    # The panel

    def _add_panel(self, server: viser.ViserServer) -> None:
        gui = server.gui
        with gui.add_folder("What will a push do?", expand_by_default=False):
            gui.add_markdown(_INTRO)
            self._controls = PushControls(server, self._replan)
            predict = gui.add_button("Predict", color="violet")
            self._execute_button = gui.add_button(
                "Execute", disabled=True, hint="Carry out these very actions in the simulator, and compare."
            )
            self._status = gui.add_html(status("push", _IDLE))
            self._report = gui.add_html("", visible=False)
            self._player = PushPlayer(gui, self._thread)
            clear = gui.add_button("Clear", hint="Remove what is drawn of a push.")
        predict.on_click(lambda event: self._run_command(partial(self._predict, event.client), event.client))
        self._execute_button.on_click(lambda event: self._run_command(self._execute, event.client))
        clear.on_click(lambda _: self._forget())

    def _replan(self) -> None:
        """Another push is chosen: what was predicted, or executed, is about a former one."""
        with self._thread.changed:
            self._has_plan = True
            if self._executing is None:
                self._prediction, self._message = None, _IDLE
            self._thread.wake()

    def _forget(self) -> None:
        with self._thread.changed:
            self._prediction, self._message, self._has_plan = None, _IDLE, False
            self._thread.wake()

    # Predicting and executing; called in viser's pool

    def _predict(self, client: Client) -> None:
        try:
            record = self._predictions.current()
            actions = self._controls.actions(record.state)
            is_warm = self._predictions.is_warm
            answer = self._predictions.submit(record.state, actions[None], _KEY)
        except OsfError as error:
            self._say(str(error))
            raise
        self._say("Predicting" if is_warm else "Loading the network, some seconds the first time")
        with self._thread.changed:
            self._has_plan = True
        request = _Request(record, actions, client, answer)
        answer.add_done_callback(lambda _: self._note_answer(request))

    def _note_answer(self, request: _Request) -> None:
        with self._thread.changed:
            self._answered = request
            self._thread.wake()

    def _say(self, text: str) -> None:
        with self._thread.changed:
            self._message = self._library.in_words(text)
            self._thread.wake()

    def _execute(self) -> None:
        with self._thread.changed:
            prediction = self._prediction
            if prediction is None or prediction.is_executed or self._executing is not None:
                raise CannotExecute("There is no new prediction to execute; press Predict first.")
            self._executing, self._message = prediction, "Executing"
            self._thread.wake()
        message = ""
        try:
            done = self._act(prediction.record.id, list(prediction.actions))
            message = _EXECUTED if done.revision == prediction.last_revision else _CHANGED
        except OsfError as error:
            message = self._library.in_words(str(error))
            raise
        finally:
            with self._thread.changed:
                self._executing = None
                self._message = message or "Not executed; the log tells more"
                if message == _CHANGED:
                    self._prediction = None
                self._thread.wake()

    # The thread

    def _draw(self) -> None:
        with self._thread.changed:
            answered, self._answered = self._answered, None
        if answered is not None:
            self._take(answered)
        self._draw_all()

    def _take(self, request: _Request) -> None:
        """Make an answer what is on view, unless the table has changed meanwhile."""
        error = request.answer.exception()
        answer = None if error else request.answer.result()
        if isinstance(error, OsfError):
            self._say(str(error))
            self._run_command(partial(_refuse, error), request.client)
        elif error is not None:
            self._say("The prediction failed; the log tells more")
            raise error
        with self._thread.changed:
            now = self._record
            if not isinstance(answer, Predicted):  # overtaken by a newer request
                return
            if now is None or (now.id, now.revision) != (request.record.id, request.record.revision):
                self._message = _CHANGED
                return
            self._prediction = PushPrediction(request.record, request.actions, answer.rollouts, answer.took_s)

    def _draw_all(self) -> None:
        with self._thread.changed:
            record, prediction, message = self._record, self._prediction, self._message
        self._draw_plan(record)
        if prediction is not self._drawn:
            message = self._draw_prediction(prediction) if prediction else self._draw_none(message)
            self._drawn = prediction
        if prediction is not None:
            self._nodes.at(self._player.advance() / STEP_S)
        if self._status.content != status("push", message):
            self._status.content = status("push", message)
        is_idle = prediction is None or prediction.is_executed or self._executing is not None
        if self._execute_button.disabled != is_idle:
            self._execute_button.disabled = is_idle

    def _draw_plan(self, record: SceneRecord | None) -> None:
        path = None
        if record is not None:
            self._controls.follow(record, is_chosen=self._has_plan)
            path = self._controls.path(record.state) if self._has_plan else None
        self._controls.show_waypoints(path is not None)
        # Once executed, the plan would only lead on from there.
        is_done = self._prediction is not None and self._prediction.is_executed
        self._nodes.plan(None if is_done else path)

    def _draw_none(self, message: str) -> str:
        self._report.visible = False
        self._player.close()
        self._nodes.clear()
        return message

    def _draw_prediction(self, prediction: PushPrediction) -> str:
        """Draw a prediction, or what came of it; returns the status message."""
        drawn = self._drawn
        if drawn is None or drawn.rollouts is not prediction.rollouts:
            self._nodes.show(prediction.rollouts)
            self._player.open(len(prediction.actions) * STEP_S)
        if prediction.truth:
            self._nodes.show_truth(prediction.truth)
        after = prediction.truth[-1] if prediction.is_executed else None
        rows = outcomes(prediction.record.state, prediction.rollouts, after, self._library)
        self._report.content = report(rows, {name: self._library.label(name) for name in prediction.rollouts.names})
        self._report.visible = True
        moving = len(self._nodes.moving)
        text = f"{moving} object{'s' * (moving != 1)} will move" if moving else "Nothing will move"
        message = f"{text}; predicted in {1000 * prediction.took_s:.0f} ms"
        if prediction.truth:
            message = _EXECUTED if prediction.is_executed else "Executing"
        with self._thread.changed:
            if self._prediction is prediction:  # else the next drawing tells what is newer, with its nodes
                self._message = message
        return message


def _refuse(error: OsfError) -> None:
    raise error
