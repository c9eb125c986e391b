import contextlib
import threading

import numpy as np
import pytest

from app.episodes.file_names import GOAL_FILE
from app.jobs.context import CancelJob, ChangeJob, JobCancelled, JobControl, RunJob
from app.jobs.job import INPUTS
from app.jobs.worker import run_job
from osfcore.contrib.robots.connect import connect
from osfcore.contrib.robots.robot import ConnectionLost, RobotRefused, RobotStopped
from osfcore.io.image_file import write_png
from tests.support.robots import NAMES, example, know_truth, serving, simulated, toward_middle, until


class Driven:
    """A job that drives a robot, in a thread of this process, as its own would."""

    def __init__(self, url, place, **more):
        write_png(place / "job" / INPUTS / GOAL_FILE, np.zeros((64, 64, 3), np.uint8))
        self.steps, self.control = [], JobControl(print)
        params = {
            "url": url, "title": "Goal", "names": list(NAMES), "goal_camera": "0", "boxes": {}, "seed": 0,
            "box": (-0.35, -0.35, 0.35, 0.35), "top_speed_m_s": 0.4,
            "settings": {"steps": 2, "plan": {"samples": 16, "horizon": 6}}, **more,
        }  # fmt: skip
        order = RunJob("robot", params, place / "data", place / "job")
        self.outcome = None
        self._thread = threading.Thread(target=self._run, args=(order,))
        self._thread.start()

    def _run(self, order):
        try:
            self.outcome = run_job(order, self.control, self.steps.append, step_interval_s=0)
        except Exception as error:
            self.outcome = error

    def wait_for(self, drives):
        """Wait until it says so."""
        until(lambda: self.outcome is not None or any(step.result["drives"] == drives for step in self.steps), 120)
        assert self.steps[-1].result["drives"] == drives, self.outcome

    def end(self):
        self._thread.join(120)
        return self.outcome


@pytest.fixture
def robot(library, monkeypatch):
    with contextlib.closing(simulated(library)) as table, serving(example().robot(table)) as url:
        know_truth(monkeypatch, table, toward_middle(table.truth()))
        yield url, table


def test_it_waits_for_permission_and_then_does_its_steps(robot, tmp_path):
    before, job = robot[1].truth().pusher, Driven(robot[0], tmp_path)
    job.wait_for("asked")
    np.testing.assert_array_equal(robot[1].truth().pusher, before)
    job.control.take(ChangeJob({"allowed": True}))
    ended = job.end()
    assert isinstance(ended, dict), ended
    assert ended["outcome"] == "out of steps"
    assert [step.done for step in job.steps][-1] == 2
    assert np.any(robot[1].truth().pusher != before)
    assert (tmp_path / "job" / "report.json").is_file()
    with contextlib.closing(connect(robot[0])) as again, pytest.raises(RobotRefused):
        again.act(np.zeros(3))


@pytest.mark.parametrize("change", [{"settings": {"steps": 3}}, {"allowed": False}, {"allowed": "no"}])
def test_no_other_change_of_parameters_is_a_permission(robot, tmp_path, change):
    before, job = robot[1].truth().pusher, Driven(robot[0], tmp_path)
    job.wait_for("asked")
    job.control.take(ChangeJob(change))
    until(lambda: job.outcome is not None or [step.result["drives"] for step in job.steps][-2:] != ["looking", "asked"])
    assert job.steps[-1].result["drives"] == "asked"
    job.control.take(CancelJob())
    assert isinstance(job.end(), JobCancelled)
    np.testing.assert_array_equal(robot[1].truth().pusher, before)


def test_cancelled_while_it_asks_nothing_has_moved(robot, tmp_path):
    before, job = robot[1].truth().pusher, Driven(robot[0], tmp_path)
    job.wait_for("asked")
    job.control.take(CancelJob())
    assert isinstance(job.end(), JobCancelled)
    np.testing.assert_array_equal(robot[1].truth().pusher, before)


def test_a_cancel_stops_the_robot_in_the_middle_of_a_motion(robot, tmp_path):
    before, job = robot[1].truth().pusher, Driven(robot[0], tmp_path, top_speed_m_s=0.005)  # one action takes seconds
    job.wait_for("asked")
    job.control.take(ChangeJob({"allowed": True}))
    until(lambda: np.any(robot[1].truth().pusher != before), 120)
    job.control.take(CancelJob())
    stood = robot[1].truth().pusher
    assert isinstance(job.end(), RobotStopped)
    assert np.abs(robot[1].truth().pusher - stood).max() < 1e-3
    assert job.steps[-1].done == 0


def test_a_robot_that_is_lost_is_announced_before_the_job_fails(library, tmp_path, monkeypatch):
    with contextlib.closing(simulated(library)) as table:
        know_truth(monkeypatch, table, toward_middle(table.truth()))
        with serving(example().robot(table)) as url:
            job = Driven(url, tmp_path)
            job.wait_for("asked")
        job.control.take(ChangeJob({"allowed": True}))
        assert isinstance(job.end(), ConnectionLost)
        assert job.steps[-1].result["drives"] == "lost"
