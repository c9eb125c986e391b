import pytest

from app.jobs.folders import JobFolders
from app.jobs.job import Job, ended, job_fields
from app.jobs.registry import Jobs, WrongJobState
from app.storage.database import CannotStore, Store
from osfcore.errors import UnknownName


@pytest.fixture
def store(tmp_path):
    store = Store(tmp_path)
    yield store
    store.close()


@pytest.fixture
def jobs(store, tmp_path):
    """A registry that took over a finished job with files; it begins no work."""
    done = ended(Job("done", "collect_table", {}), "done")
    store.save_job("done", 1, job_fields(done))
    jobs = Jobs(store, tmp_path, lambda _: None)
    (jobs.folder("done") / "inputs").mkdir(parents=True)
    (jobs.folder("done") / "table.zip").write_bytes(b"much")
    jobs.start()
    yield jobs
    jobs.stop()


def test_a_finished_job_is_forgotten_with_all_its_files(jobs, tmp_path):
    jobs.forget("done")
    assert jobs.all() == ()
    assert list((tmp_path / "collections").iterdir()) == []
    with pytest.raises(UnknownName):
        jobs.forget("done")


def test_one_without_files_is_forgotten_too(jobs):
    (jobs.folder("done") / "table.zip").unlink()
    (jobs.folder("done") / "inputs").rmdir()
    jobs.folder("done").rmdir()
    jobs.forget("done")
    assert jobs.all() == ()


def test_a_job_that_waits_is_not_forgotten(jobs):
    jobs.stop()
    waiting = jobs.submit("collect_table", {})
    with pytest.raises(WrongJobState):
        jobs.forget(waiting.id)
    assert waiting in jobs.all()


def test_on_a_full_disk_the_files_go_first_and_make_room_for_forgetting_the_job(jobs, store, tmp_path, monkeypatch):
    forget_job = store.forget_job

    def needs_room(job):
        if list((tmp_path / "collections").iterdir()):
            raise CannotStore(tmp_path, "database or disk is full")
        return forget_job(job)

    monkeypatch.setattr(store, "forget_job", needs_room)
    jobs.forget("done")
    assert jobs.all() == ()
    assert list((tmp_path / "collections").iterdir()) == []


def test_a_job_whose_record_cannot_be_removed_is_still_listed(jobs, store):
    store.close()
    with pytest.raises(CannotStore):
        jobs.forget("done")
    assert jobs.get("done").id == "done"


def test_what_a_kill_left_half_removed_goes_at_the_next_start(jobs, store, tmp_path):
    jobs.stop()
    jobs.folder("done").rename(tmp_path / "collections" / ".new-000000000000")
    again = Jobs(store, tmp_path, lambda _: None)
    again.start()
    again.stop()
    assert list((tmp_path / "collections").iterdir()) == []
    again.forget("done")
    assert again.all() == ()


def test_what_a_killed_service_left_half_made_in_the_folder_of_a_job_goes_at_the_next_start(tmp_path):
    folders = JobFolders(tmp_path)
    (folders.folder("j") / ".seen").mkdir(parents=True)
    for name in ("report.json", ".video.mp4.0123"):
        (folders.folder("j") / name).write_text("x")
    folders.sweep()
    assert [path.name for path in folders.folder("j").iterdir()] == ["report.json"]
