import json
from dataclasses import asdict

import pytest

from app.episodes.settings import ChosenSettings
from app.jobs.kinds.episodes import EpisodeParams
from osfcore.control.events import EpisodeSettings
from osfcore.errors import InvalidInput
from osfcore.paper.mppi import GaussianPlanSettings
from tests.support.errors import about

GIVEN = {"steps": 7, "samples": 8, "horizon": 4, "temperature": 0.5, "cost": "image", "acting": False}


def test_they_come_back_from_a_job_as_they_were_given():
    chosen = ChosenSettings.defaults().changed(GIVEN)
    assert ChosenSettings.of_stored(json.loads(json.dumps(asdict(chosen)))) == chosen
    assert {name: getattr(chosen, name) for name in GIVEN} == GIVEN


def test_a_loop_gets_all_of_them():
    assert ChosenSettings.defaults().of_loop() == EpisodeSettings()
    loop = ChosenSettings.defaults().changed(GIVEN).of_loop()
    assert (loop.steps, loop.cost, loop.acting, loop.planning) == (7, "image", False, True)
    assert (loop.plan.samples, loop.plan.horizon, loop.plan.temperature) == (8, 4, 0.5)


@pytest.mark.parametrize("method", ["ours", "paper"])
def test_jobs_of_earlier_versions_had_those_of_the_plan_by_themselves(method):
    before = {"settings": {"steps": 5, "plan": {"samples": 9}}, "method": method}
    before |= {"scene": "s", "names": ["box"], "seed": 0, "goal": {"id": None}}
    expected = ChosenSettings.defaults(method).changed({"steps": 5, "samples": 9})
    assert EpisodeParams.from_json(before).settings == expected


@pytest.mark.parametrize(
    ("name", "value", "what"),
    [("steps", 0, "number of steps"), ("horizon", 1000, "horizon"), ("samples", 1, "number of samples")],
)
def test_what_is_out_of_range_is_refused(name, value, what):
    with pytest.raises(InvalidInput, check=about(what)):
        ChosenSettings.defaults().changed({name: value})
    with pytest.raises(InvalidInput, check=about(what)):
        ChosenSettings.of_stored({name: value})


def test_those_of_another_version_are_refused():
    with pytest.raises(TypeError):
        ChosenSettings.of_stored({"speed": 3})


def test_the_method_as_published_has_its_own_and_no_others():
    chosen, own = ChosenSettings.defaults("paper"), GaussianPlanSettings()
    assert (chosen.cost, chosen.replan_every) == ("image", 1)
    assert (chosen.samples, chosen.horizon, chosen.temperature) == (own.samples, own.horizon, own.temperature)
    assert chosen.changed({"steps": 4}).steps == 4
    for change in ({"cost": "pose"}, {"replan_every": 2}, {"planning": False}, {"acting": False}):
        with pytest.raises(InvalidInput):
            chosen.changed(change)
