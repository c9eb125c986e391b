"""A process in reserve: it takes the next episode or estimate, and another one follows it."""

import multiprocessing

import pytest

from app.jobs.job import Job
from app.jobs.process import Standby
from tests.app.conftest import until


@pytest.fixture
def standby():
    standby = Standby(after_s=0.05)
    yield standby
    standby.stop()


def job_processes():
    return {child.pid for child in multiprocessing.active_children() if child.name == "osf-job"}


def order(kind):
    return Job("j1", kind, {}, "queued", created_at="2026-01-01T00:00:00Z")


@pytest.fixture
def started(standby, tmp_path):
    """Starts the process of a job that cannot succeed; ended afterwards."""
    processes = []

    def start(kind):
        process = standby.process(order(kind), tmp_path, tmp_path, lambda _: None)
        processes.append(process)
        return process

    yield start
    for process in processes:
        process.end()


def test_an_estimate_gets_the_process_in_reserve_and_the_next_one_follows(standby, started):
    standby.prepare()
    (spare,) = until(job_processes)
    process = started("estimate")
    assert process.pid == spare
    process.end()
    (other,) = until(lambda: job_processes() - {spare})
    assert other != spare


def test_work_of_another_kind_leaves_it_in_reserve(standby, started):
    standby.prepare()
    (spare,) = until(job_processes)
    process = started("collect_table")
    assert process.pid != spare
    process.end()
    until(lambda: job_processes() == {spare})


def test_without_one_a_job_starts_its_own(started):
    assert started("estimate").pid in job_processes()


def test_one_that_died_is_not_used(standby, started):
    standby.prepare()
    (spare,) = until(job_processes)
    (child,) = [child for child in multiprocessing.active_children() if child.pid == spare]
    child.kill()
    until(lambda: spare not in job_processes())
    assert started("estimate").pid != spare


def test_nothing_is_left_once_it_was_stopped(standby):
    standby.prepare()
    until(job_processes)
    standby.stop()
    assert not job_processes()
    standby.prepare()
    assert not job_processes()
