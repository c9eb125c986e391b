"""Predicted pushes in the 3D view: the folder in the panel, and the thread that draws them and compares with the truth.

What comes from browsers, the simulation and the process that predicts is only stored; drawing happens in the thread.
"""

from __future__ import annotations

import math
import time
from collections.abc import Callable, Mapping, Sequence
from concurrent.futures import Executor, Future
from dataclasses import dataclass, replace
from functools import partial
from html import escape

import numpy as np
import viser
from jaxtyping import Float

from app.processes.messages.neural_messages import NeuralAnswer, Predicted
from app.processes.messages.scene_messages import SceneChanged, SceneRecord
from app.services.event_hub import CurrentScene
from app.services.pushes import MAX_ACTIONS, Outcome, Predictions, beyond_nearest, outcomes, toward
from app.viewer.drawing import DrawingThread, Panel, RunCommand, status
from app.viewer.nodes.push_nodes import PushNodes
from app.viewer.nodes.scene_nodes import Client, level_point
from osfcore.errors import OsfError
from osfcore.geometry.rollouts import Rollouts
from osfcore.geometry.states import SceneState
from osfcore.geometry.workspace import MAX_SPEED_M_S, PUSHER_REACH_M, STEP_S
from osfcore.objects.asset_library import AssetLibrary

_SPEED = 0.05, MAX_SPEED_M_S  # slowest and fastest
TICK_S = 0.03  # between two pictures of a moving ghost
_KEY = "viewer"
_IDLE, _AIMED = "No push is chosen yet", "Let go of the pusher to predict this push"
_EXECUTING, _EXECUTED = "Executing", "Executed. Purple: predicted; black: the true ways"
_CHANGED = "The table has changed; predict again"
Act = Callable[[str, list[np.ndarray]], SceneRecord]


class CannotExecute(OsfError):
    """Actions that may not be executed now."""


class PushPanel(Panel):
    """The folder and the nodes of predicted pushes; the same in all browsers.

    Args:
        server: whose panel gets the folder.
        library: meshes, symmetries and labels of the objects.
        pusher: the node that is dragged to choose a push.
        predictions: predicts pushes.
        commands: carries out what hands do; viser's loop must not wait for it.
        act: executes actions in a scene and returns the scene afterwards.
        run_command: carries out a command and notifies its client if it is refused.
    """

    def __init__(
        self,
        server: viser.ViserServer,
        library: AssetLibrary,
        pusher: viser.CylinderHandle,
        predictions: Predictions,
        commands: Executor,
        act: Act,
        run_command: RunCommand,
    ) -> None:
        super().__init__("push-panel", TICK_S)
        self._library = library
        self._predictions, self._commands = predictions, commands
        self._act = act
        self._run_command = run_command
        self._nodes = PushNodes(server, library)
        self._record: SceneRecord | None = None
        self._prediction: PushPrediction | None = None
        self._drawn: PushPrediction | None = None
        self._take_answer: Callable[[], None] | None = None  # what to do with one that has come
        self._message = _IDLE
        self._executing: PushPrediction | None = None
        self._target: np.ndarray | None = None  # where the pusher shall go, once somebody has chosen
        self._gui = gui = server.gui
        with gui.add_folder("What will a push do?"):
            gui.add_markdown("Drag the pusher at an object. Predicted from the **true poses** in the simulator.")
            nearest = gui.add_button("Predict toward the nearest", color="violet")
            self._speed = gui.add_slider("Speed, m/s", *_SPEED, 0.01, 0.25)
            self._execute_button = gui.add_button(
                "Push", disabled=True, hint="Carry out these very actions in the simulator, and compare."
            )
            self._status = gui.add_html(status("push", _IDLE))
            self._report = gui.add_html("", visible=False)
            self._player = PushPlayer(gui, self._thread)
            gui.add_button("Clear", hint="Remove what is drawn of a push.").on_click(lambda _: self._forget())
        nearest.on_click(lambda event: self._run_command(partial(self._predict_nearest, event.client), event.client))
        self._speed.on_update(self._change_speed)
        pusher.on_drag(self._drag)
        self._execute_button.on_click(lambda event: self._run_command(self._execute, event.client))

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

    async def _drag(self, event: viser.SceneNodeDragEvent[viser.CylinderHandle]) -> None:
        """Let the way of the pusher follow a hand, and predict where it leads once it is let go."""
        eye, through = np.asarray(event.client.camera.position), np.asarray(event.end_position, float)
        target = level_point(eye, through, float(event.start_position[2]))
        if target is not None:
            grip = np.asarray(event.start_position, float) - np.asarray(event.target.position, float)
            self._aim(np.clip((target - grip)[:2], -PUSHER_REACH_M, PUSHER_REACH_M))
        if event.phase == "end":
            self._gui.main_panel.expand()  # what is predicted is told there
            self._commands.submit(self._run_command, partial(self._predict, event.client), event.client)

    def _aim(self, target: Float[np.ndarray, "2"] | None) -> None:
        """Choose another push: what was predicted, or executed, is about a former one."""
        with self._thread.changing():
            self._target = target
            if self._executing is None:
                self._prediction, self._message = None, _IDLE

    def _forget(self) -> None:
        with self._thread.changing():
            self._prediction, self._message, self._target = None, _IDLE, None

    def _say(self, text: str) -> None:
        with self._thread.changing():
            self._message = self._library.in_words(text)

    # Predicting and executing; called in viser's pool

    def _change_speed(self, event: viser.GuiEvent[viser.GuiSliderHandle[float]]) -> None:
        """Predict the chosen push anew at another speed."""
        target = self._target
        if event.client is not None and target is not None:
            self._aim(target)
            self._run_command(partial(self._predict, event.client), event.client)

    def _predict_nearest(self, client: Client) -> None:
        self._aim(beyond_nearest(self._predictions.current().state))
        self._predict(client)

    def _predict(self, client: Client) -> None:
        try:
            record = self._predictions.current()
            actions = self._actions(record.state)
            is_warm = self._predictions.is_warm
            answer = self._predictions.submit(record.state, actions[None], _KEY)
        except OsfError as error:
            self._say(str(error))
            raise
        with self._thread.changing():
            self._message = "Predicting" if is_warm else "Loading the network, some seconds the first time"

        def receive(done: Future[NeuralAnswer]) -> None:
            with self._thread.changing():
                self._take_answer = lambda: self._take(done, record, actions, client)

        answer.add_done_callback(receive)

    def _actions(self, state: SceneState) -> Float[np.ndarray, "T 3"]:
        """The chosen push from a state [m/s].

        Raises:
            InvalidInput: if it goes nowhere, or takes too many actions.
        """
        start = np.zeros(2) if state.pusher is None else state.pusher[:2]
        target = start if self._target is None else self._target
        return toward(start, target, number_between(self._speed.value, *_SPEED))

    def _execute(self) -> None:
        with self._thread.changing():
            prediction = self._prediction
            if prediction is None or prediction.is_executed or self._executing is not None:
                raise CannotExecute("There is no new prediction to execute; drag the pusher first.")
            self._executing, self._message = prediction, _EXECUTING
        message = ""
        try:
            done = self._act(prediction.record.id, list(prediction.actions))
            message = _EXECUTED if done.revision == prediction.last_revision else _CHANGED
        except OsfError as error:
            message = self._library.in_words(str(error))
            raise
        finally:
            with self._thread.changing():
                self._executing = None
                self._message = message or "Not executed; the log has more"
                if message == _CHANGED:
                    self._prediction = None

    # The thread

    def _draw(self) -> None:
        with self._thread.changed:
            take, self._take_answer = self._take_answer, None
        if take is not None:
            take()
        with self._thread.changed:
            record, prediction, message = self._record, self._prediction, self._message
        is_executed = prediction is not None and prediction.is_executed
        self._draw_plan(record, is_executed=is_executed)
        if prediction is not self._drawn:
            if prediction is None:
                self._report.visible = False
                self._player.show(None)
                self._nodes.clear()
            else:
                message = self._draw_prediction(prediction)
            self._drawn = prediction
        if prediction is not None:
            self._nodes.at(self._player.advance() / STEP_S)
        self._status.content = status("push", message)
        self._execute_button.disabled = prediction is None or is_executed or self._executing is not None

    def _take(
        self, answer: Future[NeuralAnswer], record: SceneRecord, actions: Float[np.ndarray, "T 3"], client: Client
    ) -> None:
        """Make an answer what is on view, unless the table has changed meanwhile."""
        try:
            predicted = answer.result()
        except OsfError as error:
            self._say(str(error))
            self._run_command(answer.result, client)  # which notifies of the same
            return
        except Exception:
            self._say("The prediction failed; the log has more")
            raise
        with self._thread.changed:
            if not isinstance(predicted, Predicted):  # overtaken by a newer request
                return
            now = self._record
            if now is None or (now.id, now.revision) != (record.id, record.revision):
                self._message = _CHANGED
                return
            self._prediction = PushPrediction(record, actions, predicted.rollouts, predicted.took_s)

    def _draw_plan(self, record: SceneRecord | None, *, is_executed: bool) -> None:
        path = None
        if record is not None and record.state.pusher is not None and self._target is not None and not is_executed:
            path = np.stack([record.state.pusher[:2], self._target])
        self._nodes.plan(path)  # once executed, it would only lead on from there

    def _draw_prediction(self, prediction: PushPrediction) -> str:
        """Draw a prediction, or what came of it; returns the status message."""
        drawn = self._drawn
        if drawn is None or drawn.rollouts is not prediction.rollouts:
            self._nodes.show(prediction.rollouts)
            self._player.show(len(prediction.actions) * STEP_S)
        if prediction.truth:
            self._nodes.show_truth(prediction.truth)
            message = _EXECUTED if prediction.is_executed else _EXECUTING
        else:
            moving = len(self._nodes.moving)
            text = f"{moving} object{'s' * (moving != 1)} will move" if moving else "Nothing will move"
            message = f"{text}; predicted in {1000 * prediction.took_s:.0f} ms"
        after = prediction.truth[-1] if prediction.is_executed else None
        rows = outcomes(prediction.record.state, prediction.rollouts, after, self._library)
        self._report.content = report(rows, {name: self._library.label(name) for name in prediction.rollouts.names})
        self._report.visible = True
        with self._thread.changed:
            if self._prediction is prediction:  # else the next drawing says what is newer, with its nodes
                self._message = message
        return message


def number_between(value: object, low: float, high: float) -> float:
    """A number that a browser sent, clipped to [low, high].

    Args:
        value: which may be anything.
        low: of the range, and the result for what is not a finite number.
        high: of the range.
    """
    try:
        number = float(value)  # pyright: ignore[reportArgumentType]
    except (TypeError, ValueError, OverflowError):
        return low
    return min(max(number, low), high) if math.isfinite(number) else low


class PushPlayer:
    """Which moment of a prediction is on view. Hidden until there is a prediction.

    Args:
        gui: whose open folder gets the two elements.
        thread: draws the moment; it guards what is stored here.
    """

    def __init__(self, gui: viser.GuiApi, thread: DrawingThread) -> None:
        self._thread = thread
        self._end_s: float | None = None
        self._shown_s = 0.0
        self._playing_since: float | None = None
        self._slider = gui.add_slider("Time, s", 0.0, 1.0, 0.05, 0.0, visible=False)
        self._button = gui.add_button("Play", visible=False)
        self._slider.on_update(self._seek)
        self._button.on_click(lambda _: self._toggle())

    def show(self, end_s: float | None) -> None:
        """Show the end of another prediction, which lasts so long [s]; None hides the elements."""
        with self._thread.changed:
            self._end_s, self._shown_s, self._playing_since = end_s, end_s or 0.0, None
        if end_s is not None:
            self._slider.max = end_s
        self._slider.visible = self._button.visible = end_s is not None

    def advance(self) -> float:
        """Update the elements and wake the thread again while playing; returns the moment to draw [s]."""
        with self._thread.changed:
            if self._playing_since is not None and self._end_s is not None:
                self._shown_s = min(time.monotonic() - self._playing_since, self._end_s)
                if self._shown_s >= self._end_s:
                    self._playing_since = None
            shown_s, is_playing = self._shown_s, self._playing_since is not None
            if is_playing:
                self._thread.wake(TICK_S)
        self._button.label = "Pause" if is_playing else "Play"
        if abs(float(self._slider.value) - shown_s) > 1e-6:
            self._slider.value = shown_s
        return shown_s

    def _seek(self, event: viser.GuiEvent[viser.GuiSliderHandle[float]]) -> None:
        if event.client is not None:  # else set by `advance`
            with self._thread.changing():
                self._shown_s = number_between(event.target.value, 0.0, MAX_ACTIONS * STEP_S)
                self._playing_since = None

    def _toggle(self) -> None:
        with self._thread.changing():
            if self._end_s is None or self._playing_since is not None:
                self._playing_since = None
            else:
                begin_s = 0.0 if self._shown_s >= self._end_s - 1e-6 else self._shown_s
                self._playing_since = time.monotonic() - begin_s


# A prediction, what came of it, and its table


@dataclass(frozen=True, eq=False, slots=True)
class PushPrediction:
    """A push that was predicted, and perhaps executed.

    Attributes:
        record: the scene from which it starts.
        actions: that are tried.
        rollouts: what they were predicted to lead to.
        took_s: time that predicting took [s].
        truth: the way things truly went, as far as it has been executed; empty before.
        is_executed: whether exactly these actions, all of them, were executed.
    """

    record: SceneRecord
    actions: Float[np.ndarray, "T 3"]
    rollouts: Rollouts
    took_s: float
    truth: tuple[SceneState, ...] = ()
    is_executed: bool = False

    @property
    def last_revision(self) -> int:
        """Of the scene once it has been executed: the simulation counts actions."""
        return self.record.revision + len(self.actions)

    def after(
        self, record: SceneRecord, states: tuple[SceneState, ...], executing: PushPrediction | None
    ) -> PushPrediction | None:
        """What is left of it after a change: it outlives the execution of its own actions, and nothing else.

        Args:
            record: the scene after the change.
            states: the way there.
            executing: whose actions are being executed now.
        """
        if record.revision <= self.record.revision:
            return self
        is_own = executing is not None and executing.rollouts is self.rollouts
        if is_own and record.revision <= self.last_revision:
            truth = (*(self.truth or (self.record.state,)), *states, record.state)
            return replace(self, truth=truth, is_executed=record.revision == self.last_revision)
        return self if self.is_executed and record.revision == self.last_revision else None


_STYLE = "width:100%;border-collapse:collapse;font-size:0.7em;line-height:1.35"
_HEAD = "text-align:right;padding-left:0.5em;font-weight:600;vertical-align:bottom"
_CELL = "text-align:right;padding-left:0.5em;vertical-align:top;white-space:nowrap"


def report(rows: Sequence[Outcome], labels: Mapping[str, str]) -> str:
    """HTML of a table with a line for each object; labels, which users choose, are escaped."""
    if not rows:
        return ""
    is_tried = rows[0].off_mm is not None
    heads = ("Predicted", "True", "Off by") if is_tried else ("Predicted to go",)
    head = "".join(f'<th style="{_HEAD}">{text}</th>' for text in heads)
    lines = "".join(_line(row, labels.get(row.name, row.name)) for row in rows)
    return (
        f'<div style="padding:0 0.7em 0.4em"><table class="push-report" style="{_STYLE}">'
        f'<tr><th style="text-align:left">Object</th>{head}</tr>{lines}</table></div>'
    )


def _line(row: Outcome, label: str) -> str:
    cells = [_motion(row.predicted_mm, row.predicted_deg)]
    if row.went_mm is not None and row.turned_deg is not None:
        cells.append(_motion(row.went_mm, row.turned_deg))
    if row.off_mm is not None and row.off_deg is not None:
        cells.append(f"<b>{_motion(row.off_mm, row.off_deg)}</b>")
    data = "".join(f'<td style="{_CELL}">{cell}</td>' for cell in cells)
    return f'<tr data-object="{escape(row.name)}"><td>{escape(label)}</td>{data}</tr>'


def _motion(shift_mm: float, turn_deg: float) -> str:
    if shift_mm < 0.05 and turn_deg < 0.05:
        return "still"
    return f"{_digits(shift_mm)} mm<br>{_digits(turn_deg)}°"


def _digits(value: float) -> str:
    return f"{value:.1f}" if value < 9.95 else f"{value:.0f}"
