"""What will a push do? The folder in the panel, and the thread that draws predictions and compares them with the truth.

Whatever comes from browsers, the simulation and the process that predicts is only noted; drawing happens in the thread.
"""

from __future__ import annotations

import math
import time
from collections.abc import Callable, Mapping
from concurrent.futures import Future
from dataclasses import dataclass
from functools import partial

import numpy as np
import viser
from jaxtyping import Float

from app.processes.messages import CurrentScene, SceneChanged, SceneRecord
from app.processes.neural_client import Answer
from app.processes.neural_messages import Predicted
from app.services.predictions import Predictions
from app.services.pushes import MAX_ACTIONS, along, outcomes, straight, toward_nearest, way
from app.viewer.nodes.push_nodes import PushDrawing
from app.viewer.nodes.scene_nodes import Client
from app.viewer.nodes.waypoints import FEWEST, MOST, Waypoints
from app.viewer.panels.panel import RunCommand, ThreadedPanel
from app.viewer.panels.push_report import report
from app.viewer.panels.push_trial import Trial
from app.viewer.panels.status_line import status
from osfcore.errors import OsfError
from osfcore.geometry.states import SceneState
from osfcore.geometry.workspace import MAX_SPEED_M_S, STEP_S
from osfcore.objects.asset_library import AssetLibrary

STRAIGHT, PATH = "Straight", "Waypoints"
COMPASS = {"→": 0, "↗": 45, "↑": 90, "↖": 135, "←": 180, "↙": 225, "↓": 270, "↘": 315}
TICK_S = 0.03  # between two pictures of a moving ghost
_KEY = "viewer"
_INTRO = "Starts from the **true poses** in the simulator."
_IDLE = "Choose a push, then Predict"
_EXECUTED = "Executed. Purple: predicted; black: the true ways"
_CHANGED = "The table has changed; predict again"
_SPEED = (0.05, MAX_SPEED_M_S)
_DEFAULT_STEPS = 6
_FURTHER_M = 0.05
Act = Callable[[str, list[np.ndarray]], SceneRecord]


class CannotExecute(OsfError):
    """Actions that may not be executed now."""


@dataclass(frozen=True, eq=False, slots=True)
class _Asked:
    """A question and, once it is there, its answer."""

    record: SceneRecord
    actions: Float[np.ndarray, "T 3"]
    client: Client
    answer: Future[Answer]


class PushPanel(ThreadedPanel):
    """What visitors ask and see about pushes; the same for all of them.

    Args:
        server: whose panel gets the folder.
        library: knows shapes, symmetries and labels.
        predictions: to ask for.
        act: carries actions out in a scene and tells what became of it.
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
        self._drawing = PushDrawing(server, library)
        self._waypoints = Waypoints(server, self._replan)
        self._record: SceneRecord | None = None
        self._ready: Trial | None = None
        self._drawn: Trial | None = None
        self._come: _Asked | None = None
        self._told = _IDLE
        self._executing: Trial | None = None
        self._has_plan = False  # whether anybody has begun to choose a push
        self._laid: tuple[str, tuple[float, ...]] | None = None  # the scene and the pusher, as handles were laid for
        self._playing_since: float | None = None
        self._shown_s = 0.0
        self._add_panel(server.gui)

    def _store(self, event: object) -> bool:
        match event:
            case CurrentScene(record):
                self._record, self._ready, self._told = record, None, _IDLE
            case SceneChanged(record, states) if self._record is not None and record.id == self._record.id:
                self._record = record
                if self._ready is not None:
                    self._ready = self._ready.after(record, states, self._executing)
                    self._told = _CHANGED if self._ready is None else self._told
            case _:
                return False
        return True

    # The panel

    def _add_panel(self, gui: viser.GuiApi) -> None:
        with gui.add_folder("What will a push do?", expand_by_default=False):
            gui.add_markdown(_INTRO)
            self._kind = gui.add_dropdown("Push", (STRAIGHT, PATH), hint="Straight ahead, or along handles to drag.")
            self._compass = gui.add_button_group("Direction", tuple(COMPASS), hint="As seen from above, +y up.")
            self._heading = gui.add_slider("Heading, °", 0, 355, 5, 0, hint="From +x toward +y.")
            self._speed = gui.add_slider("Speed, m/s", *_SPEED, 0.01, 0.25)
            self._steps = gui.add_slider("Steps", 1, MAX_ACTIONS, 1, _DEFAULT_STEPS, hint=f"Of {STEP_S} s each.")
            self._count = gui.add_slider("Waypoints", FEWEST, MOST, 1, 3, visible=False)
            predict = gui.add_button("Predict", color="violet")
            self._execute_button = gui.add_button(
                "Execute", disabled=True, hint="Carry out these very actions in the simulator, and compare."
            )
            self._status = gui.add_html(status("push", _IDLE))
            self._report = gui.add_html("", visible=False)
            self._time = gui.add_slider("Time, s", 0.0, 1.0, 0.05, 0.0, visible=False)
            self._play = gui.add_button("Play", visible=False)
            clear = gui.add_button("Clear", hint="Remove what is drawn of a push.")
        for control in (self._heading, self._speed, self._steps, self._count):
            control.on_update(lambda event: None if event.client is None else self._replan())
        self._kind.on_update(lambda _: self._choose_kind())
        self._compass.on_click(lambda event: self._turn(event.target.value))
        predict.on_click(lambda event: self._run_command(partial(self._predict, event.client), event.client))
        self._execute_button.on_click(lambda event: self._run_command(self._execute, event.client))
        self._time.on_update(self._seek)
        self._play.on_click(lambda _: self._toggle_play())
        clear.on_click(lambda _: self._forget())

    def _choose_kind(self) -> None:
        is_path = self._is_path
        for control in (self._compass, self._heading, self._steps):
            control.visible = not is_path
        self._count.visible = is_path
        self._replan()

    @property
    def _is_path(self) -> bool:
        return self._kind.value == PATH

    def _turn(self, arrow: str) -> None:
        if arrow in COMPASS:  # clients may send anything
            self._heading.value = COMPASS[arrow]
            self._replan()

    def _replan(self) -> None:
        """Another push is chosen: what was predicted, or executed, is about a former one."""
        with self._thread.changed:
            self._has_plan = True
            if self._executing is None:
                self._ready, self._told = None, _IDLE
            self._thread.wake()

    def _seek(self, event: viser.GuiEvent[viser.GuiSliderHandle[float]]) -> None:
        if event.client is None:  # the player's own
            return
        with self._thread.changed:
            self._shown_s, self._playing_since = _number(event.target.value, 0.0, MAX_ACTIONS * STEP_S), None
            self._thread.wake()

    def _toggle_play(self) -> None:
        with self._thread.changed:
            if self._ready is None:
                return
            if self._playing_since is not None:
                self._playing_since = None
            else:
                end_s = len(self._ready.actions) * STEP_S
                begin_s = 0.0 if self._shown_s >= end_s - 1e-6 else self._shown_s
                self._playing_since = time.monotonic() - begin_s
            self._thread.wake()

    def _forget(self) -> None:
        with self._thread.changed:
            self._ready, self._told, self._has_plan = None, _IDLE, False
            self._thread.wake()

    # Predicting and executing; called in viser's pool

    def _actions(self, state: SceneState) -> Float[np.ndarray, "T 3"]:
        """What is chosen now; numbers from browsers may be anything."""
        start = np.zeros(2) if state.pusher is None else state.pusher[:2]
        speed = _number(self._speed.value, *_SPEED)
        if self._is_path:
            return along(start, self._waypoints.places(self._waypoint_count), speed)
        heading = math.radians(_number(self._heading.value, 0.0, 360.0))
        return straight(heading, speed, int(_number(self._steps.value, 1, MAX_ACTIONS)))

    @property
    def _waypoint_count(self) -> int:
        return int(_number(self._count.value, FEWEST, MOST))

    def _predict(self, client: Client) -> None:
        try:
            record = self._predictions.current()
            actions = self._actions(record.state)
            is_warm = self._predictions.is_warm
            answer = self._predictions.submit(record.state, actions[None], _KEY)
        except OsfError as error:
            self._tell(str(error))
            raise
        self._tell("Predicting" if is_warm else "Loading the network, some seconds the first time")
        with self._thread.changed:
            self._has_plan = True
        asked = _Asked(record, actions, client, answer)
        answer.add_done_callback(lambda _: self._note_answer(asked))

    def _note_answer(self, asked: _Asked) -> None:
        with self._thread.changed:
            self._come = asked
            self._thread.wake()

    def _tell(self, text: str) -> None:
        with self._thread.changed:
            self._told = text
            self._thread.wake()

    def _execute(self) -> None:
        with self._thread.changed:
            ready = self._ready
            if ready is None or ready.is_executed or self._executing is not None:
                raise CannotExecute("There is no new prediction to execute; press Predict first.")
            self._executing, self._told = ready, "Executing"
            self._thread.wake()
        told = ""
        try:
            done = self._act(ready.record.id, list(ready.actions))
            told = _EXECUTED if done.revision == ready.last_revision else _CHANGED
        except OsfError as error:
            told = str(error)
            raise
        finally:
            with self._thread.changed:
                self._executing = None
                self._told = told or "Not executed; the log tells more"
                if told == _CHANGED:
                    self._ready = None
                self._thread.wake()

    # The thread

    def _draw(self) -> None:
        with self._thread.changed:
            come, self._come = self._come, None
        if come is not None:
            self._take(come)
        self._draw_all()

    def _take(self, asked: _Asked) -> None:
        """Make an answer what is on view, unless the table has changed meanwhile."""
        error = asked.answer.exception()
        answer = None if error else asked.answer.result()
        if isinstance(error, OsfError):
            self._tell(str(error))
            self._run_command(partial(_refuse, error), asked.client)
        elif error is not None:
            self._tell("The prediction failed; the log tells more")
            raise error
        with self._thread.changed:
            now = self._record
            if not isinstance(answer, Predicted):  # overtaken by a newer question
                return
            if now is None or (now.id, now.revision) != (asked.record.id, asked.record.revision):
                self._told = _CHANGED
                return
            self._ready = Trial(asked.record, asked.actions, answer.rollouts, answer.took_s)

    def _draw_all(self) -> None:
        with self._thread.changed:
            record, ready, told = self._record, self._ready, self._told
        self._draw_plan(record)
        if ready is not self._drawn:
            told = self._draw_ready(ready) if ready else self._draw_none(told)
            self._drawn = ready
        self._draw_time(ready)
        if self._status.content != status("push", told):
            self._status.content = status("push", told)
        is_idle = ready is None or ready.is_executed or self._executing is not None
        if self._execute_button.disabled != is_idle:
            self._execute_button.disabled = is_idle

    def _draw_plan(self, record: SceneRecord | None) -> None:
        pusher = None if record is None else record.state.pusher
        if record is None or pusher is None:
            self._waypoints.show(0)
            self._drawing.plan(None)
            return
        laid = (record.id, tuple(pusher[:2]))
        if laid != self._laid:
            if self._laid is None or self._laid[0] != record.id or not self._has_plan:
                self._aim(record.state)
            self._waypoints.lay(pusher[:2], toward_nearest(record.state)[0])
            self._laid = laid
        has_plan = self._has_plan
        self._waypoints.show(self._waypoint_count if has_plan and self._is_path else 0)
        if not has_plan or self._is_done():
            self._drawing.plan(None)
        elif self._is_path:  # straight through the handles, even where that takes too many actions
            self._drawing.plan(np.concatenate([pusher[None, :2], self._waypoints.places(self._waypoint_count)]))
        else:
            self._drawing.plan(way(pusher[:2], self._actions(record.state)))

    def _aim(self, state: SceneState) -> None:
        """Begin with a push that reaches the nearest object, and goes on."""
        heading_rad, far_m = toward_nearest(state)
        self._heading.value = int(5 * round(math.degrees(heading_rad) / 5)) % 360
        step_m = STEP_S * _number(self._speed.value, *_SPEED)
        self._steps.value = min(max(math.ceil((far_m + _FURTHER_M) / step_m - 1e-9), 1), MAX_ACTIONS)

    def _is_done(self) -> bool:
        """Whether what is on view has been executed: the plan would only lead on from there."""
        ready = self._ready
        return ready is not None and ready.is_executed

    def _draw_none(self, told: str) -> str:
        self._time.visible = self._play.visible = self._report.visible = False
        self._playing_since = None
        self._drawing.clear()
        return told

    def _draw_ready(self, ready: Trial) -> str:
        """Draw a prediction, or what came of it; tells what to say of it."""
        drawn = self._drawn
        if drawn is None or drawn.rollouts is not ready.rollouts:
            self._drawing.show(ready.rollouts)
            end_s = len(ready.actions) * STEP_S
            self._time.max = end_s
            self._shown_s, self._playing_since = end_s, None
        if ready.truth:
            self._drawing.show_truth(ready.truth)
        after = ready.truth[-1] if ready.is_executed else None
        found = outcomes(ready.record.state, ready.rollouts, after, self._library)
        self._report.content = report(found, self._labels(ready.rollouts.names))
        self._time.visible = self._play.visible = self._report.visible = True
        moving = len(self._drawing.moving)
        said = f"{moving} object{'s' * (moving != 1)} will move" if moving else "Nothing will move"
        told = f"{said}; predicted in {1000 * ready.took_s:.0f} ms"
        if ready.truth:
            told = _EXECUTED if ready.is_executed else "Executing"
        with self._thread.changed:
            if self._ready is ready:  # else there is something newer to tell
                self._told = told
            return self._told

    def _labels(self, names: tuple[str, ...]) -> Mapping[str, str]:
        labels = {}
        for name in names:
            try:
                labels[name] = self._library.info(name).label
            except OsfError:
                labels[name] = name
        return labels

    def _draw_time(self, ready: Trial | None) -> None:
        if ready is None:
            return
        with self._thread.changed:
            if self._playing_since is not None:
                end_s = len(ready.actions) * STEP_S
                self._shown_s = min(time.monotonic() - self._playing_since, end_s)
                if self._shown_s >= end_s:
                    self._playing_since = None
            shown_s, is_playing = self._shown_s, self._playing_since is not None
            if is_playing:
                self._thread.wake(TICK_S)
        label = "Pause" if is_playing else "Play"
        if self._play.label != label:
            self._play.label = label
        if abs(float(self._time.value) - shown_s) > 1e-6:
            self._time.value = shown_s
        self._drawing.at(shown_s / STEP_S)


def _refuse(error: OsfError) -> None:
    raise error


def _number(value: object, low: float, high: float) -> float:
    """A number that a browser sent, within bounds; the lower one for what is none."""
    try:
        number = float(value)  # pyright: ignore[reportArgumentType]
    except (TypeError, ValueError, OverflowError):
        return low
    return min(max(number, low), high) if math.isfinite(number) else low
