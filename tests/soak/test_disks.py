"""A disk that is full or read-only: what is accepted is stored, health tells, and all goes on once there is room."""

import contextlib
import os
import shutil
import subprocess
import urllib.error

import pytest

from tests.app.conftest import until
from tests.live import call, free_port, start_service, stop_service

pytestmark = pytest.mark.soak
SIZE = 128 << 20
COLLECT = {"kind": "collect_table", "params": {"images": 60, "size": 16}}


def ran(*command):
    """Whether a command succeeded."""
    return subprocess.run(command, capture_output=True, check=False).returncode == 0


@pytest.fixture
def disk(library, tmp_path):
    """A small disk with a data directory."""
    image, place = tmp_path / "disk.img", tmp_path / "disk"
    place.mkdir()
    with image.open("wb") as file:
        file.truncate(SIZE)
    is_mounted = os.geteuid() == 0 and shutil.which("mkfs.ext4") and ran("mkfs.ext4", "-q", str(image))
    if not is_mounted or not ran("mount", "-o", "loop", str(image), str(place)):
        pytest.skip("mounting needs the rights of an administrator, and mkfs.ext4")
    data = place / "data"
    data.mkdir()
    (data / "objects").symlink_to(library.root)
    yield place
    ran("chattr", "-R", "-i", str(place))
    assert ran("umount", "-l", str(place))


@pytest.fixture(autouse=True)
def small(monkeypatch):
    """The service may use the small disk up to its end."""
    monkeypatch.setenv("OSF_MIN_FREE_BYTES", "0")


@pytest.fixture
def service(disk):
    port = free_port()
    process = start_service(disk / "data", port, disk.parent / "service.log")
    yield port, process
    stop_service(process)


def fill(disk):
    """Use all that is left."""
    with contextlib.suppress(OSError), (disk / "filler").open("wb") as filler:
        while True:
            filler.write(bytes(1 << 12))
            filler.flush()


def refused(port, method, path, body):
    """Status and sentence of a refusal; the answer if there is none."""
    try:
        return call(port, method, path, body)
    except urllib.error.HTTPError as refusal:
        return refusal.code, refusal.read().decode()


def keeps_what_it_accepts(service, disk, spoil, mend):
    port, process = service
    scene = call(port, "POST", "scenes", {"count": 2, "seed": 1})["id"]
    accepted = [call(port, "POST", "jobs", COLLECT)["id"]]
    until(lambda: call(port, "GET", f"jobs/{accepted[0]}")["state"] == "done", 60)
    spoil()
    until(lambda: call(port, "GET", "health")["status"] == "degraded")
    for _ in range(5):
        for path, body in (("jobs", COLLECT), ("scenes", {"count": 1}), ("goals", {"random": {}})):
            answer = refused(port, "POST", path, body)
            if isinstance(answer, dict):
                accepted += [answer["id"]] if path == "jobs" else []
            else:
                assert answer[0] == 507, answer
                assert str(disk) not in answer[1]
    assert call(port, "GET", f"scenes/{scene}")["id"] == scene
    mend()
    until(lambda: call(port, "GET", "health")["status"] == "ok", 30)
    accepted.append(call(port, "POST", "jobs", COLLECT)["id"])
    until(lambda: call(port, "GET", f"jobs/{accepted[-1]}")["state"] == "done", 60)
    process.kill()
    process.wait()
    again = start_service(disk / "data", port, disk.parent / "service.log")
    try:
        known = {job["id"]: job["state"] for job in call(port, "GET", "jobs?limit=500")["jobs"]}
        assert set(accepted) <= known.keys()
        assert known[accepted[0]] == known[accepted[-1]] == "done"
        assert scene in [one["id"] for one in call(port, "GET", "scenes")["scenes"]]
    finally:
        stop_service(again)


def test_a_full_disk(service, disk):
    keeps_what_it_accepts(service, disk, lambda: fill(disk), (disk / "filler").unlink)


def test_a_disk_that_refuses_every_write(service, disk):
    """As one that the system has made read-only, but for the shared memory of the database, which would kill."""
    files = [path for path in (disk / "data").rglob("*") if not path.is_symlink() and not path.name.endswith("-shm")]

    def mark(how):
        subprocess.run(["chattr", how, str(disk / "data"), *map(str, files)], check=True)

    keeps_what_it_accepts(service, disk, lambda: mark("+i"), lambda: mark("-i"))


def test_a_service_starts_on_a_full_disk_or_says_why_not(disk):
    data = disk / "data"
    port = free_port()
    stop_service(start_service(data, port, disk.parent / "service.log"))
    fill(disk)
    log = disk.parent / "second.log"
    try:
        stop_service(start_service(data, port, log))
    except RuntimeError:
        assert "Traceback" not in log.read_text()
        assert "free some space" in log.read_text()
    (disk / "filler").unlink()
    stop_service(start_service(data, port, log))
    shutil.rmtree(data / "collections", ignore_errors=True)
