import json
from dataclasses import replace

import pytest

from app.jobs.context import JobCancelled
from app.jobs.job import Job
from app.jobs.loop import INTERRUPTED_NOTE, RESUMES_NOTE, after
from app.jobs.process import JobDied, JobStopped
from osfcore.errors import OsfError

REFUSED = OsfError("It is too large.")
STOPPED, DIED = JobStopped(), JobDied()


def running(kind):
    params = {"name": "mug"} if kind == "train_field" else {}
    return Job("a", kind, params, "running", done=3, total=9, eta_s=5.0, result={"steps": 3})


@pytest.fixture
def folder(tmp_path):
    """What a job has left so far: two files, one that is half-written, and inputs."""
    folder = tmp_path / "job"
    (folder / "inputs").mkdir(parents=True)
    (folder / ".seen").mkdir()
    for name in ("report.json", "steps.csv", ".video.part"):
        (folder / name).write_text("x")
    return folder


@pytest.mark.parametrize("kind", ["episode", "collect_table", "estimate", "train_field"])
def test_what_was_done_to_its_end_is_kept(folder, kind):
    over = after(running(kind), {"n": 1}, folder)
    assert (over.state, over.note, over.result, over.error) == ("done", "Done", {"n": 1}, None)
    assert over.files == ("report.json", "steps.csv")
    assert over.finished_at is not None
    assert over.eta_s is None


@pytest.mark.parametrize(
    ("outcome", "state", "error"),
    [
        (STOPPED, "interrupted", INTERRUPTED_NOTE),
        (DIED, "failed", str(DIED)),
        (REFUSED, "failed", str(REFUSED)),
        (JobCancelled(), "cancelled", None),
    ],
)
def test_an_episode_keeps_its_steps_however_it_ends(folder, outcome, state, error):
    over = after(running("episode"), outcome, folder)
    assert not list(folder.glob(".*"))
    assert (over.state, over.error, over.files) == (state, error, ("report.json", "steps.csv"))
    assert over.is_finished
    assert (over.done, over.result) == (3, {"steps": 3})
    assert (folder / "inputs").is_dir()


@pytest.mark.parametrize("outcome", [STOPPED, DIED, REFUSED, JobCancelled()])
@pytest.mark.parametrize("told", [(None, None), ("stopped", "The robot was stopped: by something.")])
def test_a_robot_that_was_stopped_and_its_report_tell_the_same_cause(folder, outcome, told):
    (folder / "report.json").write_text(json.dumps({"outcome": told[0], "text": told[1], "steps": []}))
    why = "The robot was stopped: somebody pressed Stop."
    over = after(replace(running("robot"), error=why), outcome, folder)
    report = json.loads((folder / "report.json").read_text())
    assert report == {"outcome": "stopped", "text": over.error, "steps": []}
    assert over.result == {"steps": 3, "outcome": "stopped", "text": over.error}
    assert (over.error == why) == (outcome == JobCancelled())


def test_a_robot_whose_episode_was_over_is_not_called_stopped(folder):
    text = json.dumps({"outcome": "reached", "text": "It is reached."})
    (folder / "report.json").write_text(text)
    over = after(replace(running("robot"), result={"outcome": "reached"}), JobCancelled(), folder)
    assert (over.result, (folder / "report.json").read_text()) == ({"outcome": "reached"}, text)


def test_a_robot_that_was_stopped_without_a_report_tells_it_itself(tmp_path):
    over = after(running("robot"), JobCancelled(), tmp_path / "none")
    assert over.result["outcome"] == "stopped"
    assert "its job was cancelled" in over.result["text"]


@pytest.mark.parametrize(
    ("outcome", "state", "error"),
    [
        (STOPPED, "failed", str(STOPPED)),
        (DIED, "failed", str(DIED)),
        (REFUSED, "failed", str(REFUSED)),
        (JobCancelled(), "cancelled", None),
    ],
)
@pytest.mark.parametrize("kind", ["collect_pushes", "estimate"])
def test_half_of_anything_else_is_worth_nothing(folder, kind, outcome, state, error):
    over = after(running(kind), outcome, folder)
    assert (over.state, over.error, over.files) == (state, error, ())
    assert not folder.exists()


@pytest.mark.parametrize(("outcome", "is_advised"), [(STOPPED, True), (DIED, True), (REFUSED, False)])
def test_a_training_that_can_go_on_says_so(folder, outcome, is_advised):
    assert (RESUMES_NOTE in str(after(running("train_field"), outcome, folder).error)) == is_advised


def test_a_folder_that_has_gone_is_no_matter(tmp_path):
    for kind in ("episode", "estimate"):
        assert after(running(kind), DIED, tmp_path / "none").files == ()
