import json
from typing import get_args

import pytest

from app.jobs.job import Job, State, check_file_name, ended, job_fields, job_from_fields
from app.jobs.kinds import KINDS, check_stored
from app.jobs.kinds.collections import CollectPushesParams
from app.jobs.registry import WrongJobState
from osfcore.errors import InvalidInput, UnknownName
from tests.support.errors import about


def test_a_job_survives_json():
    job = Job("a", "collect_table", {"images": 60}, files=("x.zip",), result={"n": 1}, eta_s=1.5)
    assert job_from_fields(json.loads(json.dumps(job_fields(job)))) == job


NESTED = {"steps": 5, "plan": {"samples": 9}}
BEFORE = {  # what earlier versions stored
    "episode": {"scene": "s", "names": ["box"], "seed": 0, "settings": NESTED, "method": "ours", "goal": {"id": None}},
    "estimate": {"mode": "first", "seed": 0, "names": ["box"], "cameras": ["0"], "of": {"scene": "s", "revision": 1}},
    "train_field": {"name": "box", "source": {"mesh": "box", "set": None}, "minutes": 1, "seed": 0, "images": 60},
    "robot": {
        "url": "http://robot", "names": ["box"], "goal_camera": "0", "boxes": {"0": {"box": [1, 2, 3, 4]}}, "seed": 0,
        "settings": NESTED, "box": [-0.3, -0.3, 0.3, 0.3], "top_speed_m_s": 0.2,
    },
}  # fmt: skip


@pytest.mark.parametrize("kind", BEFORE)
def test_jobs_of_earlier_versions_are_read_and_what_later_ones_add_is_left_out(kind):
    check_stored(Job("a", kind, {**BEFORE[kind], "added": 1}))


@pytest.mark.parametrize("state", get_args(State))
def test_finished_jobs_change_no_more(state):
    assert Job("a", "x", {}, state).is_finished == (state not in ("queued", "running", "paused"))


def test_an_ended_job_has_neither_place_nor_time_left():
    over = ended(Job("a", "x", {}, "running", eta_s=3, position=1), "failed", error="No.")
    assert (over.state, over.eta_s, over.position, over.error) == ("failed", None, None, "No.")
    assert over.finished_at is not None


def test_files_have_to_be_the_jobs_own():
    job = Job("a", "x", {}, files=("pushes.h5",))
    assert check_file_name(job, "pushes.h5") == "pushes.h5"
    with pytest.raises(UnknownName):
        check_file_name(job, "../a/pushes.h5")


def test_orders_that_do_not_fit_say_so():
    told = str(WrongJobState(Job("a", "train_field", {}, "done"), "paused"))
    assert told == "This training is done, so it cannot be paused."


@pytest.mark.parametrize("available", [0, 2])
def test_more_objects_than_there_are_is_refused(available):
    with pytest.raises(InvalidInput, check=about("number of objects")):
        KINDS["collect_pushes"].check(CollectPushesParams(objects=3), str, available)
    KINDS["collect_pushes"].check(CollectPushesParams(objects=2), str, 2)
