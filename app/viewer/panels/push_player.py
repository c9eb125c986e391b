"""The time slider and the play button of a predicted push."""

from __future__ import annotations

import time

import viser

from app.services.pushes import MAX_ACTIONS
from app.viewer.drawing_thread import DrawingThread
from app.viewer.panels.push_controls import number_between
from osfcore.geometry.workspace import STEP_S

TICK_S = 0.03  # between two pictures of a moving ghost


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

    def open(self, end_s: float) -> None:
        """Show the end of another prediction, which lasts so long [s]."""
        with self._thread.changed:
            self._end_s = self._shown_s = end_s
            self._playing_since = None
        self._slider.max = end_s
        self._slider.visible = self._button.visible = True

    def close(self) -> None:
        """Hide the elements."""
        with self._thread.changed:
            self._end_s = self._playing_since = None
        self._slider.visible = self._button.visible = False

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
        label = "Pause" if is_playing else "Play"
        if self._button.label != label:
            self._button.label = label
        if abs(float(self._slider.value) - shown_s) > 1e-6:
            self._slider.value = shown_s
        return shown_s

    def _seek(self, event: viser.GuiEvent[viser.GuiSliderHandle[float]]) -> None:
        if event.client is None:  # set by `advance`
            return
        with self._thread.changed:
            self._shown_s = number_between(event.target.value, 0.0, MAX_ACTIONS * STEP_S)
            self._playing_since = None
            self._thread.wake()

    def _toggle(self) -> None:
        with self._thread.changed:
            if self._end_s is None:
                return
            if self._playing_since is not None:
                self._playing_since = None
            else:
                begin_s = 0.0 if self._shown_s >= self._end_s - 1e-6 else self._shown_s
                self._playing_since = time.monotonic() - begin_s
            self._thread.wake()
