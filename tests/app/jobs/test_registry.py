import os
import pickle
import queue
import signal
import threading
import time

import pytest

from app.jobs.context import CancelJob, JobCancelled, JobRests, JobStep, PauseJob, SceneCommand, StepJob
from app.jobs.job import JobView
from app.jobs.loop import INTERRUPTED_NOTE, RESUMES_NOTE
from app.jobs.process import JobClock, JobDied, JobStopped
from app.jobs.registry import Jobs, QueueFull, WrongJobState
from app.processes.messages.scene_messages import TakeImage
from app.processes.server import InternalError
from app.storage.database import CannotStore, Store
from app.storage.field_files import workshop
from osfcore.errors import UnknownName
from tests.app.conftest import full_disk, newest_child, until

TABLE = ("collect_table", {"images": 60, "size": 16, "seed": 0})
EPISODE = {"scene": "s1", "names": [], "seed": 0, "settings": {}, "goal": {"id": None}}
ESTIMATE = {"mode": "first", "seed": 0, "names": [], "cameras": [], "of": {"scene": "s1"}}
LONG = ("collect_table", {"images": 5000, "size": 16, "seed": 0})


@pytest.fixture
def store(data_dir):
    store = Store(data_dir)
    yield store
    store.close()


@pytest.fixture
def open_jobs(store, data_dir):
    """Opens the registry, as a service that starts; all are stopped in the end."""
    opened = []

    def open_jobs(**options):
        events = []
        jobs = Jobs(store, data_dir, events.append, **options)
        jobs.start()
        opened.append(jobs)
        return jobs, events

    yield open_jobs
    for jobs in opened:
        jobs.stop()


def pid_of_job():
    """Of the job process that was started last."""
    return newest_child("osf-job")


def settled(value, still_s=1.0):
    """A value, once it has stayed the same for a while; fails the test if it never does."""

    def stays():
        before = value()
        time.sleep(still_s)
        return value() == before

    until(stays)
    return value()


def until_state(jobs, job, *states):
    until(lambda: jobs.get(job.id).state in states, 60)
    return jobs.get(job.id)


def test_a_job_lives_and_every_change_is_told(open_jobs, store):
    jobs, events = open_jobs()
    job = jobs.submit(*TABLE)
    done = until_state(jobs, job, "done", "failed")
    assert (done.state, done.files, done.error) == ("done", ("table.zip",), None)
    until(lambda: events[-1].job.state == "done")  # told once it is on the disk, which may be after it is seen
    states = [event.job.state for event in events]
    assert (states[0], states[-1]) == ("queued", "done")
    assert set(states) == {"queued", "running", "done"}
    numbers = [event.event for event in events]
    assert numbers == sorted(set(numbers))
    assert [number for number, _ in store.events_after(0)] == numbers


@pytest.mark.slow
def test_waiting_jobs_run_in_order(open_jobs):
    jobs, _ = open_jobs()
    first, second, third = (jobs.submit(*TABLE) for _ in range(3))
    until_state(jobs, third, "done")
    assert jobs.get(first.id).finished_at <= jobs.get(second.id).started_at
    assert jobs.get(second.id).finished_at <= jobs.get(third.id).started_at
    assert [job.id for job in jobs.all()] == [third.id, second.id, first.id]


def test_the_queue_has_an_end(open_jobs):
    jobs, _ = open_jobs(max_queued=2)
    running = jobs.submit(*LONG)
    until_state(jobs, running, "running")
    jobs.submit(*TABLE)
    jobs.submit(*TABLE)
    with pytest.raises(QueueFull):
        jobs.submit(*TABLE)


def test_cancelled_work_stops_and_leaves_nothing(open_jobs):
    jobs, _ = open_jobs()
    job = jobs.submit(*LONG)
    until_state(jobs, job, "running")
    assert jobs.cancel(job.id).state == "cancelled"
    assert not jobs.folder(job.id).exists()
    with pytest.raises(WrongJobState):
        jobs.cancel(job.id)


def test_a_job_that_does_not_listen_is_ended(open_jobs):
    jobs, _ = open_jobs(cancel_grace_s=0.2)
    job = jobs.submit(*LONG)
    until(lambda: jobs.get(job.id).done > 0)
    os.kill(pid_of_job(), signal.SIGSTOP)
    assert jobs.cancel(job.id).state == "cancelled"
    assert not jobs.folder(job.id).exists()


@pytest.mark.slow
def test_a_job_that_dies_fails_and_the_next_one_runs(open_jobs):
    jobs, _ = open_jobs()
    job, following = jobs.submit(*LONG), jobs.submit(*TABLE)
    until(lambda: jobs.get(job.id).done > 0)
    os.kill(pid_of_job(), signal.SIGKILL)
    failed = until_state(jobs, job, "failed")
    assert "ended unexpectedly" in failed.error
    assert until_state(jobs, following, "done").state == "done"


@pytest.mark.slow
def test_pausing_stops_progress_and_resuming_goes_on(open_jobs):
    jobs, _ = open_jobs()
    job = jobs.submit(*LONG)
    with pytest.raises(WrongJobState):
        jobs.resume(job.id)
    until(lambda: jobs.get(job.id).done > 0)
    assert jobs.pause(job.id).state == "paused"
    held = settled(lambda: jobs.get(job.id).done)
    assert jobs.resume(job.id).state == "running"
    until(lambda: jobs.get(job.id).done > held)


@pytest.mark.slow
def test_after_a_stop_running_jobs_failed_and_waiting_ones_go_on(open_jobs):
    jobs, _ = open_jobs()
    job, waiting = jobs.submit(*LONG), jobs.submit(*TABLE)
    until(lambda: jobs.get(job.id).done > 0)
    jobs.stop()
    again, _ = open_jobs()
    failed = again.get(job.id)
    assert (failed.state, failed.error) == ("failed", str(JobStopped()))
    assert until_state(again, waiting, "done", "failed").state == "done"


def test_after_a_crash_running_jobs_failed_too(open_jobs, store):
    jobs, _ = open_jobs()
    job = jobs.submit(*LONG)
    until(lambda: jobs.get(job.id).done > 0)
    kept = dict(store.jobs())
    jobs.stop()
    for number, fields in kept.items():
        store.save_job(fields["id"], number, {**fields, "state": "paused"})  # as a killed service leaves it
    again, events = open_jobs()
    assert again.get(job.id).error == str(JobStopped())
    assert events[0].job.state == "failed"
    with pytest.raises(UnknownName):
        again.get("none")


def test_a_scene_is_held_only_by_the_running_job_that_names_it(open_jobs):
    jobs, _ = open_jobs()
    assert jobs.holder("s") is None
    job = jobs.submit(LONG[0], dict(LONG[1]))
    until(lambda: jobs.get(job.id).done > 0)
    assert jobs.holder("s") is None
    jobs.change(job.id, {"scene": "s"})
    assert jobs.holder("s").id == job.id
    jobs.pause(job.id)
    assert jobs.holder("s") is None


@pytest.mark.slow
def test_a_training_that_was_killed_says_that_it_can_go_on_and_a_cancelled_one_leaves_nothing(open_jobs, data_dir):
    jobs, _ = open_jobs()
    source = {"mesh": "009_gelatin_box", "set": None}
    params = {"name": "box", "source": source, "minutes": 10, "seed": 0, "images": 5000}
    shop = workshop(data_dir, "box")
    job = jobs.submit("train_field", params)
    until(lambda: "Image" in jobs.get(job.id).note)
    os.kill(pid_of_job(), signal.SIGKILL)
    assert RESUMES_NOTE in until_state(jobs, job, "failed").error
    assert shop.is_dir()
    again = jobs.submit("train_field", params)
    assert [live.id for live in jobs.live("train_field")] == [again.id]
    until(lambda: "Image" in jobs.get(again.id).note)
    assert jobs.cancel(again.id).state == "cancelled"
    assert not shop.exists()
    assert jobs.live("train_field") == ()


def test_cancelling_a_waiting_twin_leaves_the_workshop_of_the_running_one(open_jobs, data_dir):
    jobs, _ = open_jobs()
    source = {"mesh": "009_gelatin_box", "set": None}
    params = {"name": "box", "source": source, "minutes": 10, "seed": 0, "images": 5000}
    running = jobs.submit("train_field", params)
    until(lambda: "Image" in jobs.get(running.id).note)
    twin = jobs.submit("train_field", params)
    assert jobs.cancel(twin.id).state == "cancelled"
    assert workshop(data_dir, "box").is_dir()
    jobs.cancel(running.id)
    assert not workshop(data_dir, "box").exists()


@pytest.mark.slow
def test_progress_that_comes_too_soon_is_told_when_nothing_follows(open_jobs):
    jobs, events = open_jobs()
    job = jobs.submit(*LONG)
    until(lambda: jobs.get(job.id).done > 0)
    jobs.pause(job.id)  # a step may be on its way still
    events.clear()
    jobs.resume(job.id)
    until(lambda: jobs.get(job.id).done > 200)
    os.kill(pid_of_job(), signal.SIGSTOP)  # nothing follows, as in a long step
    until(lambda: events and events[-1].job.done == jobs.get(job.id).done)
    jobs.cancel(job.id)


def test_inputs_become_the_jobs_own_and_go_with_it(open_jobs, data_dir):
    jobs, _ = open_jobs()
    running = jobs.submit(*LONG)
    (data_dir / "given").mkdir()
    (data_dir / "given" / "file").write_text("x")
    job = jobs.submit(*TABLE, data_dir / "given")
    assert not (data_dir / "given").exists()
    assert (jobs.inputs(job.id) / "file").read_text() == "x"
    jobs.cancel(job.id)
    assert not jobs.folder(job.id).exists()
    jobs.cancel(running.id)
    with pytest.raises(CannotStore):
        jobs.submit(*TABLE, data_dir / "given")
    assert len(jobs.all()) == 2


def test_inputs_that_no_job_takes_go_at_once_and_those_of_a_killed_service_at_the_next_start(open_jobs, data_dir):
    left = data_dir / "collections" / ".new-abc"
    left.mkdir(parents=True)
    jobs, _ = open_jobs()
    assert not left.exists()
    with jobs.new_inputs() as folder, jobs.new_inputs() as other:
        (folder / "deep").mkdir(parents=True)
        assert folder.parent == left.parent != other
    assert list(left.parent.iterdir()) == []


class PlayedJob:
    """A job process whose part is played by the test."""

    def __init__(self, grace_s=0.0):
        self._orders = queue.Queue()
        self._outcome = None
        self._is_over = False
        self.is_cancelled = False
        self.listens = True

    def start(self, job, data_dir, folder, on_event):
        self.id, self.clock, self.send = job.id, JobClock(), on_event
        return self

    def end_with(self, outcome):
        """Let the process end."""
        self._outcome = outcome

    def recv(self):
        """The next order that it got."""
        return self._orders.get(timeout=10)

    def order(self, message):
        if self.listens:
            self._orders.put(pickle.loads(pickle.dumps(message)))  # as through a pipe
        return self.listens

    def cancel(self, grace_s):
        self.is_cancelled = True
        self.order(CancelJob())
        if grace_s < 1:
            self._outcome = JobCancelled()

    def wait(self):
        time.sleep(0.02)
        return self._outcome

    def end(self):
        pass


@pytest.fixture
def played():
    return PlayedJob()


def test_what_a_job_lets_the_live_view_draw_is_told_but_not_kept(open_jobs, played):
    jobs, events = open_jobs(start_process=played.start)
    job = jobs.submit("estimate", {})
    until_state(jobs, job, "running")
    played.send(JobStep(7, 10, "Look", {}, view="a view"))
    (seen,) = until(lambda: [event for event in events if isinstance(event, JobView)])
    assert (seen.job.id, seen.view) == (job.id, "a view")
    assert "a view" not in str(jobs.get(job.id))


def test_an_estimate_is_ended_without_grace(open_jobs, played):
    jobs, _ = open_jobs(cancel_grace_s=600, start_process=played.start)
    job = jobs.submit("estimate", {})
    until_state(jobs, job, "running")
    assert jobs.cancel(job.id).state == "cancelled"


def test_a_job_may_rest_after_a_round_and_go_on_by_single_steps(played, open_jobs):
    jobs, _ = open_jobs(start_process=played.start)
    job = jobs.submit("episode", {"scene": "s1"})
    until_state(jobs, job, "running")
    jobs.pause(job.id)
    assert isinstance(played.recv(), PauseJob)
    assert jobs.step(job.id).state == "running"
    assert isinstance(played.recv(), StepJob)
    played.send(JobRests())
    until_state(jobs, job, "paused")
    jobs.resume(job.id)
    with pytest.raises(WrongJobState):
        jobs.step(job.id)  # it runs anyway


def test_parameters_of_a_live_job_can_be_changed(played, open_jobs):
    jobs, _ = open_jobs(start_process=played.start)
    job = jobs.submit("episode", {"scene": "s1", "settings": {"steps": 30}})
    until_state(jobs, job, "running")
    assert jobs.change(job.id, {"settings": {"steps": 5}}).params == {"scene": "s1", "settings": {"steps": 5}}
    assert played.recv().params == {"settings": {"steps": 5}}
    played.end_with({})
    until_state(jobs, job, "done")
    with pytest.raises(WrongJobState):
        jobs.change(job.id, {"settings": {}})


def test_what_a_job_asks_for_is_done_with_its_own_scene_only(played, open_jobs):
    asked = []

    def serve(command):
        asked.append(command)
        if command.camera == "7":
            raise UnknownName("camera", "7", ["0", "goal"])
        return b"picture"

    jobs, _ = open_jobs(serve=serve, start_process=played.start)
    job = jobs.submit("episode", {"scene": "s1"})
    until_state(jobs, job, "running")
    played.send(SceneCommand(TakeImage("s1", "goal", 32)))
    assert played.recv().value == b"picture"
    played.send(SceneCommand(TakeImage("s1", "7", 32)))
    assert "camera" in str(played.recv().error)
    played.send(SceneCommand(TakeImage("s2", "goal", 32)))
    assert "s2" in str(played.recv().error)
    assert [command.id for command in asked] == ["s1", "s1"]


@pytest.mark.parametrize("served", [lambda: {}["no such key"], lambda: threading.Lock()])
def test_what_cannot_be_answered_is_logged_and_told_to_the_job_that_waits(played, open_jobs, caplog, served):
    jobs, _ = open_jobs(serve=lambda _: served(), start_process=played.start)
    job = jobs.submit("episode", {"scene": "s1"})
    until_state(jobs, job, "running")
    played.send(SceneCommand(TakeImage("s1", "goal", 32), 7))
    answer = played.recv()
    assert (answer.number, type(answer.error)) == (7, InternalError)
    assert [record.exc_info is not None for record in caplog.records] == [True]


@pytest.mark.parametrize("order", ["pause", "change"])
def test_an_order_that_reaches_nobody_is_refused_and_changes_nothing(played, open_jobs, order):
    jobs, _ = open_jobs(start_process=played.start)
    job = jobs.submit("episode", {"scene": "s1"})
    running = until_state(jobs, job, "running")
    played.listens = False
    with pytest.raises(WrongJobState):
        jobs.pause(job.id) if order == "pause" else jobs.change(job.id, {"settings": {}})
    assert jobs.get(job.id) == running


def begun(jobs, kind="episode"):
    """A job of which one step is done."""
    job = jobs.submit(kind, {"episode": EPISODE, "estimate": ESTIMATE}[kind])
    until_state(jobs, job, "running")
    (jobs.folder(job.id) / "report.json").write_text("{}")
    return job


def test_an_episode_that_a_stop_interrupts_keeps_its_steps(played, open_jobs):
    jobs, _ = open_jobs(start_process=played.start)
    job = begun(jobs)
    played.send(JobStep(1, 3, "Pushing", {"stage": "act", "steps": 1}))
    until(lambda: jobs.get(job.id).done == 1)
    jobs.stop()
    again, _ = open_jobs(start_process=played.start)
    kept = again.get(job.id)
    assert (kept.state, kept.error, kept.files) == ("interrupted", INTERRUPTED_NOTE, ("report.json",))
    assert (kept.done, kept.result) == (1, {"stage": "act", "steps": 1})
    assert (again.folder(job.id) / "report.json").is_file()
    with pytest.raises(WrongJobState):
        again.cancel(job.id)


@pytest.mark.parametrize("state", ["running", "paused"])
@pytest.mark.parametrize(("kind", "over"), [("episode", "interrupted"), ("estimate", "failed")])
def test_after_a_crash_an_episode_is_interrupted_and_half_of_anything_else_is_removed(
    played, open_jobs, store, kind, over, state
):
    jobs, _ = open_jobs(start_process=played.start)
    job = begun(jobs, kind)
    ((number, fields),) = store.jobs()
    folder = jobs.folder(job.id)
    jobs.stop()
    folder.mkdir(exist_ok=True)
    (folder / "report.json").write_text("{}")
    store.save_job(job.id, number, {**fields, "state": state})  # as a killed service leaves it
    again, events = open_jobs(start_process=played.start)
    assert again.get(job.id).state == events[0].job.state == over
    assert folder.exists() == (kind == "episode")
    assert again.get(job.id).files == (("report.json",) if kind == "episode" else ())


def test_an_episode_whose_process_dies_fails_and_keeps_its_steps(played, open_jobs):
    jobs, _ = open_jobs(start_process=played.start)
    job = begun(jobs)
    played.end_with(JobDied())
    failed = until_state(jobs, job, "failed", "done")
    assert (failed.state, failed.error, failed.files) == ("failed", str(JobDied()), ("report.json",))
    assert (jobs.folder(job.id) / "report.json").is_file()


@pytest.mark.parametrize("answers", [True, False])
def test_a_cancelled_episode_keeps_its_steps_whether_it_listens_or_not(played, open_jobs, answers):
    jobs, _ = open_jobs(cancel_grace_s=600 if answers else 0.1, start_process=played.start)
    job = begun(jobs)
    if answers:
        played.end_with(JobCancelled())
    over = jobs.cancel(job.id) if not answers else until_state(jobs, job, "cancelled", "done")
    assert (over.state, over.error, over.files) == ("cancelled", None, ("report.json",))
    if not answers:
        assert isinstance(played.recv(), CancelJob)


def test_an_episode_that_was_cancelled_before_it_began_leaves_nothing(played, open_jobs, data_dir):
    jobs, _ = open_jobs(start_process=played.start)
    begun(jobs)
    (data_dir / "given").mkdir()
    waiting = jobs.submit("episode", {"scene": "s1"}, data_dir / "given")
    assert jobs.cancel(waiting.id).state == "cancelled"
    assert not jobs.folder(waiting.id).exists()


def test_a_job_whose_simulation_hangs_is_heard_and_cancelled_all_the_same(played, open_jobs):
    hangs = threading.Event()

    def serve(command):
        hangs.wait(60)

    jobs, _ = open_jobs(serve=serve, start_process=played.start, cancel_grace_s=0.1)
    job = jobs.submit("episode", {"scene": "s1"})
    until_state(jobs, job, "running")
    played.send(SceneCommand(TakeImage("s1", "goal", 32)))
    played.send(JobStep(3, 10, "Look", {}))
    until(lambda: jobs.get(job.id).done == 3)
    assert jobs.cancel(job.id).state == "cancelled"
    hangs.set()


@pytest.mark.slow
def test_a_frozen_job_fails_and_the_next_one_runs(open_jobs):
    jobs, _ = open_jobs()
    job, following = jobs.submit(*LONG), jobs.submit(*TABLE)
    until(lambda: jobs.get(job.id).done > 0)
    os.kill(pid_of_job(), signal.SIGSTOP)
    assert "was frozen" in until_state(jobs, job, "failed").error
    assert until_state(jobs, following, "done").state == "done"


def test_a_failure_of_the_loop_is_told_and_jobs_go_on_once_its_cause_is_gone(played, open_jobs):
    is_broken = threading.Event()
    is_broken.set()

    def start(*arguments):
        if is_broken.is_set():
            raise RuntimeError("can't start new thread")
        return played.start(*arguments)

    jobs, _ = open_jobs(start_process=start)
    job = jobs.submit("episode", {"scene": "s1"})
    until(lambda: jobs.problem)
    assert "tried again" in jobs.problem
    assert jobs.get(job.id).state == "queued"
    is_broken.clear()
    until_state(jobs, job, "running")
    played.end_with({})
    until_state(jobs, job, "done")
    until(lambda: jobs.problem is None)


def test_a_job_that_cannot_be_stored_is_not_accepted_and_leaves_nothing(played, open_jobs, store, data_dir):
    jobs, events = open_jobs(start_process=played.start)
    running = begun(jobs)
    (data_dir / "given").mkdir()
    with full_disk(), pytest.raises(CannotStore):
        jobs.submit("episode", {"scene": "s2"}, data_dir / "given")
    assert [job.id for job in jobs.all()] == [running.id]
    assert [fields["id"] for _, fields in store.jobs()] == [running.id]
    assert [path.name for path in (data_dir / "collections").iterdir()] == [running.id]
    assert {event.job.id for event in events} <= {running.id}  # whose start may be announced late
    accepted = jobs.submit("episode", {"scene": "s2"})
    (announced,) = [event.job for event in events if event.job.id == accepted.id]
    assert accepted.position == announced.position == 1


def test_a_job_goes_on_while_the_disk_is_full_and_its_end_is_stored_once_there_is_room(played, open_jobs, store):
    jobs, events = open_jobs(start_process=played.start)
    job = begun(jobs)
    with full_disk():
        played.send(JobStep(1, 3, "Pushing", {"steps": 1}))
        until(lambda: jobs.get(job.id).done == 1)
        played.end_with({"n": 1})
        until_state(jobs, job, "done")
        until(lambda: (store.unwritten, events[-1].event) == (1, 0))
        assert [fields["state"] for _, fields in store.jobs()] == ["running"]
    until(lambda: store.unwritten == 0)  # nothing else happens, no job runs
    ((_, fields),) = store.jobs()
    assert (fields["state"], fields["result"]) == ("done", {"n": 1})
    assert store.events_after(0)[-1][1]["state"] == "done"


def test_a_stored_job_that_makes_no_sense_does_not_stop_the_start(played, open_jobs, store):
    store.save_job("a", 1, {"id": "a", "kind": "dance", "params": {}})
    store.save_job("b", 2, {"id": "b", "kind": "episode"})
    store.save_job("c", 3, {"id": "c", "kind": "episode", "params": EPISODE, "state": "dreaming"})
    store.save_job("d", 4, {"id": "d", "kind": "episode", "params": EPISODE, "state": "done", "mood": "added later"})
    jobs, _ = open_jobs(start_process=played.start)
    (job,) = jobs.all()
    assert (job.id, job.state, job.files, job.note) == ("d", "done", (), "Waiting")
    assert [(entry.kind, entry.id) for entry in store.set_aside] == [("job", "a"), ("job", "b"), ("job", "c")]
    assert "'params'" in store.set_aside[1].reason
    assert jobs.submit("episode", {}).id not in ("a", "b", "c", "d")
