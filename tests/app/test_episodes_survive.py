"""What is left when processes are killed in the middle of an episode, and when disks refuse."""

import json
import os
import shutil
import signal

import cv2
import pytest

from app.jobs.loop import INTERRUPTED_NOTE
from app.jobs.process import JobDied
from tests.app.conftest import until
from tests.live import SMALL, begun, call, children, free_port, start_service, stop_service

NAMES = ["005_tomato_soup_can", "006_mustard_bottle"]
LOOKING_S = 240.0  # the first frame takes some seconds of an idle machine


def far_away(port, scene):
    """One that has done a step, with many to go."""
    episode = begun(port, scene, SMALL)

    def has_begun():
        now = call(port, "GET", f"episodes/{episode}")
        assert now["status"] in ("queued", "running"), now
        return len(now["steps"]) >= 2

    until(has_begun, LOOKING_S)
    return episode


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
