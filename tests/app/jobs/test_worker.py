import dataclasses
from pathlib import Path
from threading import Thread
from typing import get_args

import pytest

from app.jobs.context import (
    CancelJob,
    ChangeJob,
    JobCancelled,
    JobControl,
    JobRests,
    JobStep,
    PauseJob,
    ResumeJob,
    RunJob,
    SceneCommand,
    StepJob,
)
from app.jobs.job import Job
from app.jobs.kind import JobKind
from app.jobs.kinds import KINDS, KindName, check_stored, in_words
from app.jobs.loop import after
from app.jobs.params import JobParams
from app.jobs.process import JobStopped
from app.jobs.worker import job_main, run_job
from app.processes.child_process import launch
from app.processes.client import ProcessClient, ProcessUnavailable
from app.processes.messages.scene_messages import TakeImage
from app.processes.server import Answer, InternalError, Ready, Request, child_main
from osfcore.errors import OsfError, UnknownName
from tests.app.conftest import until
from tests.support.errors import about

TABLE = {"images": 60, "size": 16, "seed": 0}


@pytest.fixture
def start(data_dir, tmp_path):
    """Starts a job process; gives its client, the future of its outcome, its events and its folder."""
    started = []

    def start(kind, params):
        folder, events = tmp_path / f"job{len(started)}", []
        folder.mkdir()
        client = ProcessClient(job_main, (), "job", on_event=events.append)
        started.append(client)
        return client, client.submit(RunJob(kind, params, data_dir, folder)), events, folder

    yield start
    for client in started:
        client.stop()


def test_steps_rise_to_the_end_and_files_are_there(start):
    _, outcome, steps, folder = start("collect_table", TABLE)
    assert isinstance(outcome.result(60), dict)
    assert all(isinstance(step, JobStep) for step in steps)
    counts = [step.done for step in steps]
    assert counts == sorted(counts)
    assert counts[-1] == steps[-1].total == 60
    assert {path.name for path in folder.iterdir()} == {"table", "table.zip"}


def test_a_refusal_is_told_in_its_words(start):
    _, outcome, events, _ = start("collect_object", {**TABLE, "name": "teapot"})
    with pytest.raises(UnknownName, check=about("teapot")):
        outcome.result(60)
    assert events == []


def test_a_defect_is_told_without_a_traceback(start):
    _, outcome, _, _ = start("juggle", {})
    with pytest.raises(InternalError) as failure:
        outcome.result(60)
    assert "\n" not in str(failure.value)


def test_cancelling_ends_between_steps(start):
    client, outcome, events, folder = start("collect_table", {**TABLE, "images": 5000})
    until(lambda: events)
    client.notify(CancelJob())
    assert isinstance(outcome.result(60), JobCancelled)
    assert not (folder / "table").exists()


def test_a_job_whose_service_died_ends(data_dir, tmp_path):
    process, connection = launch(child_main, "job", job_main, "job")
    connection.send(Request(1, RunJob("collect_table", {**TABLE, "images": 5000}, data_dir, tmp_path)))
    while not isinstance(connection.recv(), JobStep):
        pass
    connection.close()
    until(lambda: not process.is_alive())


def test_a_process_in_reserve_ends_with_its_service():
    process, connection = launch(child_main, "job", job_main, "job", True)
    while not isinstance(connection.recv(), Ready):
        pass
    connection.close()
    until(lambda: not process.is_alive())


def test_pausing_holds_and_cancelling_frees():
    control, held = JobControl(lambda _: None), []
    control.take(PauseJob())
    assert control.is_paused
    waiting = Thread(target=lambda: held.append(control.must_stop()))
    waiting.start()
    control.take(ResumeJob())
    waiting.join(10)
    assert held == [False]
    control.take(PauseJob())
    control.take(CancelJob())
    assert control.must_stop()


def test_a_single_step_rests_after_its_round():
    control = JobControl(lambda _: None)
    control.take(PauseJob())
    control.take(StepJob())
    assert not control.must_stop()  # it goes on in the middle of the round
    assert control.rests_now()
    assert control.is_paused
    control.take(ResumeJob())
    assert not control.rests_now()


def test_changes_come_in_order_and_once():
    control = JobControl(lambda _: None)
    control.take(ChangeJob({"a": 1}))
    control.take(ChangeJob({"a": 2}))
    assert control.changes() == [{"a": 1}, {"a": 2}]
    assert control.changes() == []


def test_a_job_asks_for_what_it_wants_done_with_its_scene():
    sent = []
    control, command = JobControl(sent.append), TakeImage("s1", "goal", 32)
    control.take(Answer(0, b"picture"))
    assert control.ask(command) == b"picture"
    assert [type(message) for message in sent] == [SceneCommand]
    assert sent[0].command == command
    control.take(Answer(sent[0].number + 1, error=UnknownName("scene", "s1", [])))
    with pytest.raises(UnknownName, check=about("scene")):
        control.ask(command)


def test_a_job_that_nobody_answers_stops_waiting_and_takes_no_late_answer_for_another():
    sent = []
    control, command = JobControl(sent.append, answer_s=0.0), TakeImage("s1", "goal", 32)
    with pytest.raises(ProcessUnavailable):
        control.ask(command)
    control.take(Answer(sent[0].number, b"too late"))
    control.take(Answer(sent[0].number + 1, b"picture"))
    assert control.ask(command) == b"picture"


def test_a_job_that_is_cancelled_stops_waiting_for_an_answer():
    control = JobControl(lambda _: control.take(CancelJob()), answer_s=float("inf"))
    with pytest.raises(OsfError):
        control.ask(TakeImage("s1", "goal", 32))


@dataclasses.dataclass(frozen=True)
class Told:
    """A step of a job, as many come in no time."""

    done: int
    must_be_reported: bool
    total: int = 100
    note: str = "Working"
    view: str | None = None
    ends_round: bool = False


def run(monkeypatch, steps, orders=()):
    """What a job tells that makes these steps faster than they are worth telling."""
    told = []
    control = JobControl(told.append)
    for order in orders:
        control.take(order)

    def send(message):
        told.append(message)
        if isinstance(message, JobRests):
            control.take(ResumeJob())

    monkeypatch.setitem(KINDS, "played", JobKind("played", "play", lambda *_: (step for step in steps), JobParams))
    outcome = run_job(RunJob("played", {}, Path("d"), Path("f")), control, send, float("inf"))
    return told, outcome


def test_steps_that_must_be_reported_are_never_thinned_out(monkeypatch):
    steps = [Told(number, number % 3 == 0, view=f"view {number}") for number in range(30)]
    told, outcome = run(monkeypatch, steps)
    assert [step.done for step in told] == list(range(0, 30, 3))
    assert [step.view for step in told] == [f"view {number}" for number in range(0, 30, 3)]
    assert outcome == {"must_be_reported": False, "ends_round": False}


def test_steps_that_come_too_fast_are_not_told_but_the_last_one_is(monkeypatch):
    told, _ = run(monkeypatch, [Told(number, False) for number in range(101)])
    assert [step.done for step in told] == [100]


def test_a_job_tells_that_it_rests_where_a_round_ends_and_only_then(monkeypatch):
    steps = [Told(1, True), Told(2, True, ends_round=True), Told(3, True), Told(4, True, ends_round=True)]
    told, _ = run(monkeypatch, steps, [PauseJob(), StepJob()])
    assert [type(message) for message in told] == [JobStep, JobStep, JobRests, JobStep, JobStep]


def test_every_kind_that_can_be_asked_for_has_a_record():
    assert list(KINDS) == list(get_args(KindName))


def test_a_kind_of_job_is_one_record(monkeypatch, tmp_path):
    """What a record says is enough for the service to run such a job and to bring it to its end."""

    class CountParams(JobParams):
        to: int

    def count(params, place):
        for done in range(1, params.to + 1):
            yield Told(done, True)

    monkeypatch.setitem(KINDS, "count", JobKind("count", "counting", count, CountParams, keeps_steps=True))
    told = []
    outcome = run_job(RunJob("count", {"to": 3}, tmp_path, tmp_path), JobControl(told.append), told.append)
    assert [step.done for step in told] == [1, 2, 3]
    running = Job("a", "count", {"to": 3}, "running")
    check_stored(running)
    assert in_words(running) == "counting"
    assert after(running, outcome, tmp_path).state == "done"
    assert after(running, JobStopped(), tmp_path).state == "interrupted"
