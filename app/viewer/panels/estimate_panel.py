"""Estimates in the 3D view: the folder in the panel, and the thread that draws the newest step.

Steps come from the jobs' thread and are only stored there; drawing, at most some times a second, happens here.
"""

from __future__ import annotations

import io
import time
from collections.abc import Callable
from concurrent.futures import Future
from functools import partial

import numpy as np
import viser
from PIL import Image
from viser import uplot

from app.jobs.job import Job, JobChanged, JobView
from app.processes.messages.neural_messages import Comparison, NeuralAnswer
from app.processes.process_client import ProcessClient
from app.services.estimates import KIND, Asked, Estimates
from app.services.event_hub import CurrentScene
from app.viewer.nodes.estimate_nodes import EstimateNodes
from app.viewer.nodes.scene_nodes import SceneNodes
from app.viewer.panels.loss_curves import LossCurves
from app.viewer.panels.panel import Panel, RunCommand
from osfcore.errors import OsfError
from osfcore.estimation.steps import EstimateStep

DRAW_INTERVAL_S = 0.1
PICTURE_INTERVAL_S = 0.7  # rendering takes time from the estimator
_COLOURS = ("#1f77b4", "#ff7f0e", "#2ca02c", "#d62728", "#9467bd", "#8c564b", "#e377c2", "#7f7f7f")
_NO_PICTURE = np.full((32, 64, 3), 235, np.uint8)
_IDLE = "Not asked yet"


class EstimatePanel(Panel):
    """The folder and the nodes of estimates; the same in all browsers.

    Args:
        server: whose panel gets the folder.
        nodes: of the table, whose own light is the true one, and of estimates.
        estimates: starts estimates, and compares them with their images.
        neural: renders the comparisons.
        run_command: carries out a command and notifies its client if it is refused.
        cancel: ends a job.
    """

    def __init__(
        self,
        server: viser.ViserServer,
        nodes: tuple[SceneNodes, EstimateNodes],
        estimates: Estimates,
        neural: ProcessClient,
        run_command: RunCommand,
        cancel: Callable[[str], object],
    ) -> None:
        super().__init__("estimate-panel", DRAW_INTERVAL_S)
        self._server = server
        self._estimates = estimates
        self._table, self._nodes = nodes
        self._neural = neural
        self._run_command = run_command
        self._cancel = cancel
        self._job: Job | None = None
        self._steps: list[EstimateStep] = []  # not drawn yet
        self._current: str | None = None
        self._curves = LossCurves(())
        self._drawn_job: str | None = None
        self._plot: viser.GuiUplotHandle | None = None
        self._plot_names: list[str] = []
        self._picture_at = 0.0
        self._picture: Future[NeuralAnswer] | None = None
        self._picture_of: object = None
        self._add_panel(server.gui)

    def add_client(self, client: viser.ClientHandle) -> None:
        """Draw again: comparisons are rendered only while somebody is connected."""
        self._thread.wake()

    def forget(self) -> None:
        """Remove what a finished estimate has drawn. Any thread may call."""
        with self._thread.changed:
            if self._job is None or self._job.is_finished:
                self._job, self._steps = None, []
                self._thread.wake()

    def _store(self, event: object) -> bool:
        match event:
            case JobView(job, EstimateStep() as step) if job.kind == KIND and self._is_here(job):
                self._job = job
                self._steps.append(step)
            case JobChanged(_, job) if job.kind == KIND and self._is_here(job) and self._is_latest(job):
                self._job = job
            case CurrentScene(record):
                self._current = None if record is None else record.id
                if self._job is not None and not self._is_here(self._job):
                    self._job, self._steps = None, []
            case _:
                return False
        return True

    def _is_here(self, job: Job) -> bool:
        """Whether it is about what is on view; uploads are shown on any table."""
        return job.params["of"]["scene"] in (None, self._current)

    def _is_latest(self, job: Job) -> bool:
        """One that waits does not take the view from one that runs."""
        mine = self._job
        return mine is None or mine.id == job.id or mine.is_finished or job.state == "running"

    # The panel

    def _add_panel(self, gui: viser.GuiApi) -> None:
        with gui.add_folder("Estimate") as self._folder:
            start = gui.add_button("Estimate from cameras", hint="Find poses and light from the four images and masks.")
            self._stop_button = gui.add_button("Cancel", disabled=True)
            self._bar = gui.add_progress_bar(0.0, visible=False)
            self._status = gui.add_text("Status", _IDLE, disabled=True)
            self._wants_tried = gui.add_checkbox("Show candidates", True, hint="Poses and lights that are tried.")
            self._wants_truth = gui.add_checkbox(
                "Show true light", False, hint="The simulation's own light, which the estimator does not know."
            )
            clear = gui.add_button("Clear", hint="Remove what an estimate has drawn.")
            self._camera = gui.add_dropdown("Camera", ("0",))
            self._image = gui.add_image(_NO_PICTURE, label="Observed, rendered", visible=False)
        start.on_click(lambda event: self._run_command(lambda: self._estimates.of_scene(Asked()), event.client))
        self._stop_button.on_click(lambda event: self._run_command(self._cancel_mine, event.client))
        self._wants_tried.on_update(lambda event: self._nodes.show_candidates(event.target.value))
        self._wants_truth.on_update(lambda _: self._draw_truth())
        self._camera.on_update(lambda _: self._look_again())
        clear.on_click(lambda _: self.forget())

    def _cancel_mine(self) -> None:
        job = self._job
        if job is not None:
            self._cancel(job.id)

    def _look_again(self) -> None:
        with self._thread.changed:
            self._picture_of = None
            self._thread.wake()

    # The thread

    def _draw(self) -> None:
        with self._thread.changed:
            job, steps, self._steps = self._job, self._steps, []
        if job is None or job.state in ("cancelled", "failed") or job.id != self._drawn_job:
            self._clear(job)
        if steps:
            for step in steps:
                self._curves = self._curves.with_step(step)
            self._nodes.show(steps[-1])
            self._nodes.show_candidates(self._wants_tried.value)
            self._draw_curves()
        self._draw_truth()
        self._draw_state(job)
        if job is not None and self._drawn_job == job.id and not self._nodes.is_empty:
            self._draw_picture(job)

    def _clear(self, job: Job | None) -> None:
        self._nodes.clear()
        self._image.visible = False
        self._curves = LossCurves(() if job is None else tuple(job.params["names"]))
        self._drawn_job = None if job is None else job.id
        if job is not None and self._camera.options != tuple(job.params["cameras"]):
            self._camera.options = tuple(job.params["cameras"])

    def _draw_truth(self) -> None:
        """While a guess is on view, the green cube is the guess; the lamp itself is shown on demand, in its colour."""
        if self._nodes.is_empty:
            self._table.show_lamp(is_on=True, by=KIND)
        else:
            self._table.show_lamp(is_on=self._wants_truth.value, name="true light", by=KIND)

    def _draw_state(self, job: Job | None) -> None:
        is_live = job is not None and not job.is_finished
        self._stop_button.disabled = not is_live
        self._bar.visible = is_live
        if job is None:
            self._status.value = _IDLE
            return
        self._bar.value = 100.0 * job.done / max(job.total, 1)
        trusted = (job.result or {}).get("trusted")
        texts = {"failed": job.error or job.note, "cancelled": "Cancelled", "queued": "Waiting for other jobs"}
        done = "Done, trusted" if trusted else "Done, NOT trusted; see the orange objects"
        self._status.value = done if job.state == "done" else texts.get(job.state, job.note)

    def _draw_curves(self) -> None:
        names = [*(name.split("_", 1)[-1].replace("_", " ") for name in self._curves.names), "whole"]
        data = self._curves.drawn()
        if self._plot is not None and len(self._plot.data) == len(data) and self._plot_names == names:
            self._plot.data = data
            return
        if self._plot is not None:
            self._plot.remove()
        series = [uplot.Series(label="step")]
        for number, name in enumerate(names):
            colour = "#444444" if name == "whole" else _COLOURS[number % len(_COLOURS)]
            series.append(uplot.Series(label=name, stroke=colour, width=2))
        self._plot_names = names
        with self._folder:
            self._plot = self._server.gui.add_uplot(
                data,
                tuple(series),
                title="Loss, relative within each stage",
                scales={"x": uplot.Scale(time=False), "y": uplot.Scale(range=(0.0, 1.05))},
                legend=uplot.Legend(show=True, live=False),
                aspect=1.3,
            )

    # Observed beside rendered

    def _draw_picture(self, job: Job) -> None:
        """Request a comparison if something has changed, none is on its way, and the last one is old enough."""
        key = (job.id, len(self._curves.rows), self._camera.value)
        if self._picture is not None or self._picture_of == key or not self._server.get_clients():
            return
        wait_s = self._picture_at + PICTURE_INTERVAL_S - time.monotonic()
        if wait_s > 0:
            self._thread.wake(wait_s)
            return
        try:
            order = self._estimates.comparison(job, job.params["cameras"].index(self._camera.value))
        except (OsfError, ValueError):  # nothing to show yet, or a camera of another estimate
            return
        self._picture_at, self._picture_of = time.monotonic(), key
        self._picture = self._neural.submit(order)
        self._picture.add_done_callback(partial(self._receive, job.id))

    def _receive(self, job: str, answer: Future[NeuralAnswer]) -> None:
        self._picture = None
        if answer.exception() is None and isinstance(result := answer.result(), Comparison) and job == self._drawn_job:
            with Image.open(io.BytesIO(result.comparison)) as picture:
                pixels = np.asarray(picture.convert("RGB"))
            self._image.image = pixels[:, : 2 * pixels.shape[1] // 3]
            self._image.visible = True
        self._thread.wake()
