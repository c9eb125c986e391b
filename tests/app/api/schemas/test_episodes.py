from dataclasses import replace

import numpy as np
import pytest
from pydantic import ValidationError

from app.api.schemas.episodes import EpisodeIn, EpisodeOut, ServiceSettings, SettingsIn
from app.jobs.job import Job
from app.jobs.kinds.episodes import settings_of
from app.services.episodes import nested
from osfcore.control.events import EpisodeSettings
from osfcore.paper.mppi import GaussianPlanSettings

PARAMS = {"scene": "s", "names": ["box"], "seed": 3, "settings": nested({"steps": 5}), "goal": {"id": "g"}}
STEP = {
    "step": 0,
    "seconds": {"first": 9.5},
    "image_cost": 0.25,
    "ssim": 0.9,
    "to_goal_mm": {"box": 60.0},
    "to_goal_deg": {"box": 3.0},
    "estimate_off_mm": {"box": 1.0},
    "truth": {"objects": []},
    "estimate": {},
}
REPORT = {"steps": [STEP], "noticed": [{"step": 0, "matter": "goal", "text": "It is odd."}]}


def told(job, report=None, files=()):
    return EpisodeOut.of_job(job, "A box", settings_of(job.params["settings"]), report, files)


def test_only_what_was_said_is_handed_on():
    assert SettingsIn.model_validate({}).given() == {}
    assert SettingsIn.model_validate({"steps": 5, "acting": False, "cost": None}).given() == {
        "steps": 5,
        "acting": False,
    }
    asked = EpisodeIn.model_validate({"goal": "g", "settings": {"samples": 8}}).asked()
    assert (asked.scene, asked.goal, asked.poses, asked.seed, asked.settings) == (None, "g", None, 0, {"samples": 8})


@pytest.mark.parametrize(
    "body",
    [
        {"goal": ""},
        {"goal": "x" * 65},
        {"poses": []},
        {"seed": -1},
        {"settings": None},
        {"settings": {"steps": 0}},
        {"settings": {"steps": 1.5}},
        {"settings": {"cost": "both"}},
        {"settings": {"temperature": float("nan")}},
        {"settings": {"noise_m": 1}},
        {"more": 1},
    ],
)
def test_what_makes_no_sense_is_refused(body):
    with pytest.raises(ValidationError):
        EpisodeIn.model_validate(body)


def test_an_episode_that_waits_has_nothing_to_tell_yet():
    out = told(Job("a", "episode", PARAMS, position=2))
    assert (out.status, out.position, out.stage, out.outcome, out.text) == ("queued", 2, None, None, None)
    assert (out.steps, out.notices, out.files) == ([], [], [])
    assert (out.scene, out.goal, out.objects, out.seed, out.settings.steps) == ("s", "g", ["box"], 3, 5)


def test_a_running_one_tells_stage_steps_and_notices():
    job = Job("a", "episode", PARAMS, "running", 2, 5, "Pushing", result={"stage": "act", "steps": 3})
    out = told(job, REPORT, ("report.json",))
    assert (out.stage, out.done, out.total, out.note, out.files) == ("act", 2, 5, "Pushing", ["report.json"])
    assert out.steps[0].model_dump() == {key: STEP[key] for key in STEP if key not in ("truth", "estimate")} | {
        "truly_to_goal_mm": None,
        "light_off_deg": None,
    }
    assert out.notices[0].text == "It is odd."


@pytest.mark.parametrize("state", ["done", "failed", "cancelled", "interrupted"])
def test_one_that_is_over_tells_how_it_ended(state):
    result = {"stage": "next", "steps": 3, "outcome": "reached", "text": "It is there."}
    out = told(replace(Job("a", "episode", PARAMS, state), result=result, error="No." if state == "failed" else None))
    assert (out.status, out.outcome, out.text) == (state, "reached", "It is there.")
    assert EpisodeOut.model_validate_json(out.model_dump_json()) == out


def test_the_defaults_are_those_of_an_episode_without_settings():
    defaults = ServiceSettings.now().episode.defaults
    assert defaults.method == "ours"
    assert nested(defaults.model_dump(exclude={"method"})) == nested({})
    assert defaults.model_dump()["steps"] == EpisodeSettings().steps


def test_what_counts_as_reached_is_what_an_episode_goes_by():
    told, rule = ServiceSettings.now().episode, EpisodeSettings()
    assert (told.reached_mm, told.reached_deg) == pytest.approx((1000 * rule.reached_m, np.rad2deg(rule.reached_rad)))


def test_the_method_as_published_has_defaults_of_its_own():
    published = ServiceSettings.now().episode.published
    assert (published.method, published.cost, published.replan_every) == ("paper", "image", 1)
    own = GaussianPlanSettings()
    assert (published.samples, published.horizon, published.temperature) == (own.samples, own.horizon, own.temperature)
    assert nested(published.model_dump(exclude={"method"}), "paper") == nested({}, "paper")


def test_the_method_is_asked_for_among_the_settings():
    asked = EpisodeIn.model_validate({"scene": "s", "goal": "g", "settings": {"method": "paper", "steps": 4}}).asked()
    assert (asked.method, asked.settings) == ("paper", {"steps": 4})
    assert EpisodeIn.model_validate({"scene": "s", "goal": "g"}).asked().method == "ours"


def test_steps_of_a_method_that_looks_at_images_alone_know_no_distances():
    step = {"step": 0, "seconds": {}, "image_cost": 0.1, "to_goal_mm": None, "to_goal_deg": None, "estimate_off_mm": {}}
    job = Job("a", "episode", {**PARAMS, "method": "paper"})
    out = EpisodeOut.of_job(job, "A", EpisodeSettings(), {"steps": [step]}, ())
    assert out.settings.method == "paper"
    assert (out.steps[0].to_goal_mm, out.steps[0].to_goal_deg) == (None, None)


def test_the_time_that_it_took_is_told_with_and_without_its_steps():
    job = Job("j", "episode", PARAMS, "done", result={"seconds": 31.25})
    assert told(job).seconds == told(job, {**REPORT, "seconds": 31.25}).seconds == 31.25
