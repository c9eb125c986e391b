"""What is left when processes are killed in the middle of an episode, when disks refuse, and after many episodes."""

import json
import os
import re
import shutil
import signal
import statistics
import urllib.request
from pathlib import Path

import cv2
import pytest

from app.jobs.outcomes import INTERRUPTED_NOTE, JobDied
from tests.app.conftest import until
from tests.live import free_port, start_service, stop_service

NAMES = ["005_tomato_soup_can", "006_mustard_bottle"]
SMALL = {"steps": 30, "samples": 8, "horizon": 4}
LOOKING_S = 240.0  # the first frame takes some seconds of an idle machine


def call(port, method, path, body=None):
    request = urllib.request.Request(f"http://127.0.0.1:{port}/api/{path}", method=method)
    if body is not None:
        request.data = json.dumps(body).encode()
        request.add_header("Content-Type", "application/json")
    with urllib.request.urlopen(request, timeout=60) as answer:
        content = answer.read()
    return json.loads(content) if answer.headers["Content-Type"].startswith("application/json") else content


def children(process):
    """Processes that a process has started, the newest last."""
    threads = Path(f"/proc/{process}/task").glob("*/children")
    return sorted((int(pid) for path in threads for pid in path.read_text().split()), key=_started)


def _started(process):
    return int(Path(f"/proc/{process}/stat").read_text().rsplit(")", 1)[1].split()[19])


def begun(port, scene, settings):
    """An episode whose goal no short looks ahead will reach."""
    objects = call(port, "GET", f"scenes/{scene}")["objects"]
    poses = [{key: entry[key] for key in ("name", "position", "quaternion")} for entry in objects]
    poses[0]["position"][0] += 0.15 if poses[0]["position"][0] < 0 else -0.15
    return call(port, "POST", "episodes", {"scene": scene, "poses": poses, "settings": settings})["id"]


def far_away(port, scene):
    """One that has done a step, with many to go."""
    episode = begun(port, scene, SMALL)

    def has_begun():
        now = call(port, "GET", f"episodes/{episode}")
        assert now["status"] in ("queued", "running"), now
        return len(now["steps"]) >= 2

    until(has_begun, LOOKING_S)
    return episode


def resident_mb(process):
    """Memory of a process and of all that it has started."""
    text = Path(f"/proc/{process}/smaps_rollup").read_text()
    own = int(re.search(r"^Pss: +(\d+) kB", text, re.MULTILINE)[1]) / 1024  # shared pages count once in all
    return own + sum(resident_mb(child) for child in children(process))


@pytest.fixture
def place(library, tmp_path):
    shutil.copytree(library.root, tmp_path / "data" / "objects", copy_function=os.link)
    return tmp_path / "data"


@pytest.mark.slow
def test_what_was_done_is_there_after_the_worker_and_after_the_service_was_killed(place):
    port = free_port()
    service = start_service(place, port)
    try:
        scene = call(port, "POST", "scenes", {"objects": NAMES, "seed": 3})["id"]
        first = far_away(port, scene)
        os.kill(children(service.pid)[-1], signal.SIGKILL)
        until(lambda: call(port, "GET", f"episodes/{first}")["status"] == "failed")
        broken = call(port, "GET", f"episodes/{first}")
        assert broken["error"] == str(JobDied())
        assert len(broken["steps"]) >= 2
        second = far_away(port, scene)
        before = call(port, "GET", f"episodes/{second}")
        service.kill()
        service.wait()
        service = start_service(place, port)
        after = call(port, "GET", f"episodes/{second}")
        assert (after["status"], after["error"]) == ("interrupted", INTERRUPTED_NOTE)
        assert after["steps"][: len(before["steps"])] == before["steps"]
        assert call(port, "GET", f"episodes/{first}")["steps"] == broken["steps"]
        video = place / "video.mp4"
        video.write_bytes(call(port, "GET", f"episodes/{second}/files/video.mp4"))
        assert cv2.VideoCapture(str(video)).get(cv2.CAP_PROP_FRAME_COUNT) == len(after["steps"])
        assert len(call(port, "GET", f"episodes/{second}/files/episode.viser")) > 10_000
    finally:
        stop_service(service)


@pytest.mark.slow
def test_a_disk_that_refuses_ends_an_episode_with_a_clear_error_and_nothing_half_written(place):
    port = free_port()
    service = start_service(place, port)
    try:
        scene = call(port, "POST", "scenes", {"objects": NAMES, "seed": 3})["id"]
        episode = far_away(port, scene)
        folder = place / "collections" / episode
        steps = len(call(port, "GET", f"episodes/{episode}")["steps"])
        (folder / "frames").rename(folder / "frames.before")
        (folder / "frames").write_text("in the way of every further frame")
        until(lambda: call(port, "GET", f"episodes/{episode}")["status"] == "failed", LOOKING_S)
        after = call(port, "GET", f"episodes/{episode}")
        assert "cannot be written" in after["error"]
        assert len(after["steps"]) >= steps
        json.loads((folder / "report.json").read_text())
        assert not list(folder.glob(".*report*"))
        assert call(port, "GET", "health")["status"] == "ok"
    finally:
        stop_service(service)


@pytest.mark.soak
def test_twenty_episodes_in_a_row_leave_memory_as_it_was_after_a_few(place):
    port = free_port()
    service = start_service(place, port)
    try:
        scene = call(port, "POST", "scenes", {"objects": NAMES, "seed": 3})["id"]
        idle, used_mb = len(children(service.pid)), []
        for _ in range(20):
            episode = begun(port, scene, {**SMALL, "steps": 3})
            until(lambda name=episode: call(port, "GET", f"episodes/{name}")["status"] == "done", LOOKING_S)
            assert len(call(port, "GET", f"episodes/{episode}/files/video.mp4")) > 1000
            until(lambda: len(children(service.pid)) == idle)  # the process of the episode has ended too
            used_mb.append(resident_mb(service.pid))
        early, late = statistics.median(used_mb[4:9]), statistics.median(used_mb[-5:])
        assert late - early < 0.02 * early, [round(mb, 1) for mb in used_mb]
    finally:
        stop_service(service)
