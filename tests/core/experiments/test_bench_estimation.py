import json
from dataclasses import replace

import pytest

import osfcore.experiments.bench_estimation as module
from osfcore.errors import InvalidInput, MissingAssets
from osfcore.experiments.bench_estimation import BenchEstimate, bench_estimate
from osfcore.objects.asset_library import AssetLibrary
from tests.core.experiments.oracle import Oracle

CONFIG = BenchEstimate(scenes=2, objects=2, steps=3, size=32)


@pytest.fixture
def oracle(monkeypatch):
    oracle = Oracle()
    oracle.install(monkeypatch)
    for name in ("estimate_first", "estimate_next", "estimate_goal"):
        monkeypatch.setattr(module, name, getattr(oracle, name.removeprefix("estimate_")))
    monkeypatch.setattr(module, "warm_models", lambda *_: None)
    return oracle


def test_every_kind_of_estimate_is_timed(solids, library, oracle):
    steps = list(bench_estimate(CONFIG, solids, library))
    assert [step.done for step in steps] == [0, 0, 1, 2]
    assert [step.report is None for step in steps] == [True] * 3 + [False]
    each = ["first search 4", "next", "next", "next", "goal"]
    assert [what for what, _ in oracle.asked] == each * 2
    result = json.loads(json.dumps(steps[-1].report.to_json()))
    assert all(result[key] > 0 for key in ("first_s", "next_s", "next_s_p90", "goal_s"))
    assert result["refine_hz"] == pytest.approx(1 / result["next_s"])
    assert (result["scenes"], result["objects"]) == (2, 2)
    assert result["next_s_p90"] >= result["next_s"]


@pytest.mark.slow
def test_the_scenes_are_the_same_every_time(solids, library, oracle):
    for _ in range(2):
        list(bench_estimate(replace(CONFIG, scenes=1), solids, library))
    (first, second) = oracle.asked[:5], oracle.asked[5:]
    assert first == second


def test_what_cannot_be_measured_is_told_at_once(solids, library, oracle, tmp_path):
    for wrong, words in (
        ({"scenes": 0}, "number of scenes is 0"),
        ({"steps": 0}, "later frames"),
        ({"objects": 9}, "between 1 and 8"),
        ({"objects": 5}, "at most 3"),
        ({"seed": -1}, "seed"),
    ):
        with pytest.raises(InvalidInput, match=words):
            next(bench_estimate(replace(CONFIG, **wrong), solids, library))
    with pytest.raises(MissingAssets):
        next(bench_estimate(CONFIG, solids, AssetLibrary(tmp_path)))
    assert not oracle.asked
