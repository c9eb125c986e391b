"""Episodes one after the other: memory and disk stay as they are. OSF_SOAK_HOURS says for how long (0.25)."""

import os
import statistics
import subprocess
import time
import urllib.request

import pytest

from tests.app.conftest import until
from tests.live import SMALL, begun, call, children, free_port, resident_mb, start_service, stop_service

pytestmark = pytest.mark.soak
HOURS = float(os.environ.get("OSF_SOAK_HOURS", "0.25"))
NAMES = ["005_tomato_soup_can", "006_mustard_bottle"]
FEWEST = 12  # episodes, so that there is something to compare
LOOKING_S = 240.0


def disk_mb(folder):
    """What a folder takes on the disk."""
    return int(subprocess.run(["du", "-sk", folder], capture_output=True, check=True).stdout.split()[0]) / 1024


def test_a_night_of_episodes_leaves_memory_and_disk_as_they_were(data_dir):
    port = free_port()
    service = start_service(data_dir, port)
    try:
        scene = call(port, "POST", "scenes", {"objects": NAMES, "seed": 3})["id"]
        end, idle, used_mb, stored_mb = time.monotonic() + 3600 * HOURS, len(children(service.pid)), [], []
        while time.monotonic() < end or len(used_mb) < FEWEST:
            episode = begun(port, scene, {**SMALL, "steps": 3})
            until(lambda name=episode: call(port, "GET", f"episodes/{name}")["status"] == "done", LOOKING_S)
            with urllib.request.urlopen(f"http://127.0.0.1:{port}/api/episodes/{episode}/files/video.mp4") as video:
                assert len(video.read()) > 1000
            call(port, "DELETE", f"episodes/{episode}?forget=true")
            until(lambda: len(children(service.pid)) == idle)  # the process of the episode has ended too
            used_mb.append(resident_mb(service.pid))
            stored_mb.append(disk_mb(data_dir))
        third = len(used_mb) // 3
        for what, values, slack in (("memory", used_mb, 0.02), ("disk", stored_mb, 0.02)):
            early, late = statistics.median(values[third : 2 * third]), statistics.median(values[-third:])
            print(f"{len(values)} episodes, {what}: {early:.1f} MB, then {late:.1f} MB")
            assert late - early < slack * early + 1, [round(mb, 1) for mb in values]
    finally:
        stop_service(service)
