import dataclasses
from multiprocessing import Pipe
from pathlib import Path
from threading import Event

import pytest

import app.jobs.worker as job_process
from app.jobs.context import JobContext, JobControl
from app.jobs.worker import KINDS, job_main
from app.processes.child_process import end, launch
from app.processes.messages import (
    AskStage,
    CancelJob,
    ChangeJob,
    Failure,
    JobCancelled,
    JobDone,
    JobRests,
    JobStep,
    PauseJob,
    Reply,
    ResumeJob,
    StepJob,
    TakeImage,
)
from app.processes.sim_client import StageError
from tests.app.conftest import until

TABLE = {"images": 60, "size": 16, "seed": 0}


@pytest.fixture
def start(data_dir, tmp_path):
    """Starts a job process; gives its pipe. All of them end with the test."""
    started = []

    def start(kind, params):
        folder = tmp_path / f"job{len(started)}"
        folder.mkdir()
        started.append((*launch(job_main, "job", kind, params, JobContext(data_dir, folder)), folder))
        return started[-1]

    yield start
    for process, connection, _ in started:
        end(process)
        connection.close()


def told(connection):
    """All messages to the end."""
    messages = []
    try:
        while True:
            messages.append(connection.recv())
    except EOFError:
        return messages


def test_steps_rise_to_the_end_and_files_are_there(start):
    process, connection, folder = start("collect_table", TABLE)
    *steps, last = told(connection)
    assert isinstance(last, JobDone)
    assert all(isinstance(step, JobStep) for step in steps)
    counts = [step.done for step in steps]
    assert counts == sorted(counts)
    assert counts[-1] == steps[-1].total == 60
    assert {path.name for path in folder.iterdir()} == {"table", "table.zip"}
    end(process, 5)
    assert process.exitcode == 0


def test_a_refusal_is_told_in_its_words(start):
    _, connection, _ = start("collect_object", {**TABLE, "name": "teapot"})
    (failure,) = told(connection)
    assert isinstance(failure, Failure)
    assert failure.kind == "UnknownName"
    assert "teapot" in failure.text


def test_a_defect_is_told_without_a_traceback(start):
    _, connection, _ = start("collect_table", {"sizes": 3})
    (failure,) = told(connection)
    assert failure.kind == "Internal"
    assert "TypeError" in failure.text
    assert "\n" not in failure.text


def test_cancelling_ends_between_steps(start):
    _, connection, folder = start("collect_table", {**TABLE, "images": 5000})
    connection.recv()
    connection.send(CancelJob())
    assert isinstance(told(connection)[-1], JobCancelled)
    assert not (folder / "table").exists()


def test_a_job_whose_service_died_ends(start):
    process, connection, _ = start("collect_table", {**TABLE, "images": 5000})
    connection.recv()
    connection.close()
    until(lambda: not process.is_alive())


def test_pausing_holds_and_cancelling_frees():
    ours, theirs = Pipe()
    lost = Event()
    orders = JobControl(theirs, on_lost=lost.set)
    ours.send(PauseJob())
    until(lambda: not orders._may_run.is_set())
    ours.send(ResumeJob())
    until(orders._may_run.is_set)
    assert not orders.must_stop()
    ours.send(PauseJob())
    ours.send(CancelJob())
    until(orders._is_cancelled.is_set)
    assert orders.must_stop()
    ours.close()
    assert lost.wait(10)
    theirs.close()


@pytest.fixture
def wired():
    """Orders of a job, and the service's end of the pipe."""
    ours, theirs = Pipe()
    lost = Event()
    yield JobControl(theirs, on_lost=lost.set), ours
    ours.close()
    assert lost.wait(10)
    theirs.close()


def test_a_single_step_rests_after_its_round(wired):
    orders, ours = wired
    ours.send(PauseJob())
    until(lambda: not orders._may_run.is_set())
    ours.send(StepJob())
    until(orders._may_run.is_set)
    assert not orders.must_stop()  # it goes on in the middle of the round
    assert orders.rests_now()
    assert not orders._may_run.is_set()
    ours.send(ResumeJob())
    until(orders._may_run.is_set)
    assert not orders.rests_now()


def test_changes_come_in_order_and_once(wired):
    orders, ours = wired
    ours.send(ChangeJob({"a": 1}))
    ours.send(ChangeJob({"a": 2}))
    until(lambda: orders._changes.qsize() == 2)
    assert orders.changes() == [{"a": 1}, {"a": 2}]
    assert orders.changes() == []


def test_a_job_asks_for_what_it_wants_done_with_its_scene(wired):
    orders, ours = wired
    asked = TakeImage("s1", "goal", 32)
    ours.send(Reply(0, b"picture"))
    assert orders.ask(asked) == b"picture"
    message = ours.recv()
    assert isinstance(message, AskStage)
    assert message.command == asked
    ours.send(Failure(0, "UnknownName", "There is no such scene."))
    with pytest.raises(StageError, match="no such scene"):
        orders.ask(asked)


@dataclasses.dataclass(frozen=True)
class Told:
    """A step of a job, as many come in no time."""

    done: int
    must_be_told: bool
    total: int = 100
    note: str = "Working"
    seen: str | None = None
    ends_round: bool = False


def run(monkeypatch, steps, orders=None):
    """What a job tells that makes these steps faster than they are worth telling."""
    told = []

    class Connection:
        send = staticmethod(told.append)

    class Deaf:
        def rests_now(self):
            return False

        def must_stop(self):
            return False

    monkeypatch.setitem(KINDS, "played", lambda *_: (step for step in steps))
    monkeypatch.setattr(job_process, "STEP_INTERVAL_S", float("inf"))
    outcome = job_process._run(Connection(), orders or Deaf(), "played", {}, JobContext(Path("d"), Path("f")))
    return told, outcome


def test_steps_that_must_be_told_are_never_thinned_out(monkeypatch):
    steps = [Told(number, number % 3 == 0, seen=f"view {number}") for number in range(30)]
    told, outcome = run(monkeypatch, steps)
    assert [step.done for step in told] == list(range(0, 30, 3))
    assert [step.seen for step in told] == [f"view {number}" for number in range(0, 30, 3)]
    assert isinstance(outcome, JobDone)
    assert outcome.result == {"must_be_told": False, "ends_round": False}


def test_steps_that_come_too_fast_are_not_told_but_the_last_one_is(monkeypatch):
    told, _ = run(monkeypatch, [Told(number, False) for number in range(101)])
    assert [step.done for step in told] == [100]


def test_a_job_tells_that_it_rests_where_a_round_ends_and_only_then(monkeypatch):
    class Stepping:
        left = 1

        def rests_now(self):
            self.left -= 1
            return self.left >= 0

        def must_stop(self):
            return False

    steps = [Told(1, True), Told(2, True, ends_round=True), Told(3, True), Told(4, True, ends_round=True)]
    told, _ = run(monkeypatch, steps, Stepping())
    assert [type(message) for message in told] == [JobStep, JobStep, JobRests, JobStep, JobStep]


def test_every_kind_that_rest_tells_of_exists():
    assert set(KINDS) == {
        "collect_pushes",
        "collect_object",
        "collect_table",
        "fetch_assets",
        "train_field",
        "estimate",
        "episode",
    }
    assert JobContext(Path("d"), Path("f")).library.root == Path("d/objects")
