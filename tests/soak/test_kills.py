"""Every process is killed or stopped at random moments, the service itself included: nothing is lost, all comes back.

OSF_SOAK_MOMENTS says how many moments (100).
"""

import contextlib
import os
import random
import signal
import time
import urllib.error
from pathlib import Path

import pytest

from app.jobs.job import FINISHED
from tests.app.conftest import until
from tests.live import SMALL, begun, call, children, free_port, start_service, stop_service

pytestmark = pytest.mark.soak
MOMENTS = int(os.environ.get("OSF_SOAK_MOMENTS", "100"))
HEALED_S = 5.0
NAMES = ["005_tomato_soup_can", "006_mustard_bottle"]
TRAINING = {"kind": "train_field", "params": {"name": "soak", "source": {"mesh": "009_gelatin_box"}, "minutes": 5}}


class Watched:
    """A service under attack, and what it has promised so far."""

    def __init__(self, data_dir):
        self.data_dir, self.port = data_dir, free_port()
        self.process = start_service(data_dir, self.port)
        self.scene = call(self.port, "POST", "scenes", {"objects": NAMES, "seed": 3})["id"]
        self.steps = {}  # that were told, by episode
        self.jobs = set()  # that were accepted

    def restart(self):
        """Start the service again after it was killed."""
        self.process.wait()
        self.process = start_service(self.data_dir, self.port)

    def work(self, number):
        """Let some job run, now an episode, now a training."""
        jobs = call(self.port, "GET", "jobs?limit=500")["jobs"]
        if all(job["state"] in FINISHED for job in jobs):
            if number % 3:
                self.jobs.add(begun(self.port, self.scene, SMALL))
            else:
                self.jobs.add(call(self.port, "POST", "jobs", TRAINING)["id"])

    def check(self):
        """Whatever was promised is still there."""
        known = {job["id"]: job for job in call(self.port, "GET", "jobs?limit=500")["jobs"]}
        assert self.jobs <= known.keys()
        for episode in (job["id"] for job in known.values() if job["kind"] == "episode"):
            steps = call(self.port, "GET", f"episodes/{episode}")["steps"]
            before = self.steps.get(episode, [])
            assert steps[: len(before)] == before
            self.steps[episode] = steps

    def heals(self, victim):
        """Seconds until pushes and health are as ever, a stopped process included in what is replaced."""
        start = time.monotonic()

        def is_well():
            if is_stopped(victim):
                return False
            with contextlib.suppress(urllib.error.HTTPError, OSError):
                jobs = call(self.port, "GET", "jobs?limit=500")["jobs"]
                is_driven = any(job["state"] == "running" and job["kind"] == "episode" for job in jobs)
                if not is_driven:
                    call(self.port, "POST", f"scenes/{self.scene}/actions", {"actions": [[0.0, 0, 0]]})
                return call(self.port, "GET", "health")["status"] == "ok"
            return False

        until(is_well, 60)
        return time.monotonic() - start


def is_stopped(process):
    """Whether a process is there and stands still; the tracker of shared memory may."""
    place = Path(f"/proc/{process}")
    try:
        is_tracker = b"resource_tracker" in (place / "cmdline").read_bytes()
        return not is_tracker and (place / "stat").read_text().rpartition(")")[2].split()[0] == "T"
    except OSError:
        return False


@pytest.fixture
def watched(data_dir):
    watched = Watched(data_dir)
    yield watched
    stop_service(watched.process)


def test_nothing_is_lost_whatever_is_killed_or_stopped(watched):
    rng, took_s = random.Random(0), []
    for number in range(MOMENTS):
        watched.work(number)
        time.sleep(rng.uniform(0, 4))
        watched.check()
        how = rng.choice([signal.SIGKILL, signal.SIGSTOP])
        victim = rng.choice([watched.process.pid, *children(watched.process.pid)])
        if victim == watched.process.pid:
            how = signal.SIGKILL  # whoever stops the service wants it to stand still
        with contextlib.suppress(ProcessLookupError):
            os.kill(victim, how)
        time.sleep(0.05)  # until the system has done it
        if victim == watched.process.pid:
            watched.restart()
        took_s.append(watched.heals(victim))
        watched.check()
    print(f"{MOMENTS} moments: healed within {max(took_s):.1f} s, in the middle {sorted(took_s)[MOMENTS // 2]:.1f} s")
    assert max(took_s) < HEALED_S, sorted(took_s)[-5:]
