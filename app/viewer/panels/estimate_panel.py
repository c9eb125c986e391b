"""Estimates in the 3D view: the folder in the panel, and the thread that draws the newest step.

Steps come from the jobs' thread and are only stored there; drawing, at most some times a second, happens here.
"""

from __future__ import annotations

import viser

from app.jobs.job import Job, JobChanged, JobView
from app.services.estimates import KIND
from app.services.event_hub import CurrentScene
from app.viewer.nodes.estimate_nodes import EstimateNodes
from app.viewer.nodes.scene_nodes import SceneNodes
from app.viewer.panels.panel import Panel
from osfcore.estimation.steps import EstimateStep

DRAW_INTERVAL_S = 0.1


class EstimatePanel(Panel):
    """The nodes of estimates, and a folder to choose which are drawn; the same in all browsers.

    Args:
        server: whose panel gets the folder.
        nodes: of the table, whose own light is the true one, and of estimates.
    """

    def __init__(self, server: viser.ViserServer, nodes: tuple[SceneNodes, EstimateNodes]) -> None:
        super().__init__("estimate-panel", DRAW_INTERVAL_S)
        self._table, self._nodes = nodes
        self._job: Job | None = None
        self._step: EstimateStep | None = None  # not drawn yet
        self._current: str | None = None
        self._drawn_job: str | None = None
        self._add_panel(server.gui)

    def forget(self) -> None:
        """Remove what a finished estimate has drawn. Any thread may call."""
        with self._thread.changed:
            if self._job is None or self._job.is_finished:
                self._job, self._step = None, None
                self._thread.wake()

    def _store(self, event: object) -> bool:
        match event:
            case JobView(job, EstimateStep() as step) if job.kind == KIND and self._is_here(job):
                self._job, self._step = job, step
            case JobChanged(_, job) if job.kind == KIND and self._is_here(job) and self._is_latest(job):
                self._job = job
            case CurrentScene(record):
                self._current = None if record is None else record.id
                if self._job is not None and not self._is_here(self._job):
                    self._job, self._step = None, None
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
        with gui.add_folder("Estimate", expand_by_default=False):
            self._wants_tried = gui.add_checkbox("Show candidates", True, hint="Poses and lights that are tried.")
            self._wants_truth = gui.add_checkbox(
                "Show true light", False, hint="The simulation's own light, which the estimator does not know."
            )
            clear = gui.add_button("Clear", hint="Remove what an estimate has drawn.")
        self._wants_tried.on_update(lambda event: self._nodes.show_candidates(event.target.value))
        self._wants_truth.on_update(lambda _: self._draw_truth())
        clear.on_click(lambda _: self.forget())

    # The thread

    def _draw(self) -> None:
        with self._thread.changed:
            job, step, self._step = self._job, self._step, None
        if job is None or job.state in ("cancelled", "failed") or job.id != self._drawn_job:
            self._nodes.clear()
            self._drawn_job = None if job is None else job.id
        if step is not None:
            self._nodes.show(step)
            self._nodes.show_candidates(self._wants_tried.value)
        self._draw_truth()

    def _draw_truth(self) -> None:
        """While a guess is on view, the green cube is the guess; the lamp itself is shown on demand, in its colour."""
        if self._nodes.is_empty:
            self._table.show_lamp(is_on=True, by=KIND)
        else:
            self._table.show_lamp(is_on=self._wants_truth.value, name="true light", by=KIND)
