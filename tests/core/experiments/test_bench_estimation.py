import json
from dataclasses import replace

import pytest

import osfcore.experiments.bench_estimation as module
from osfcore.errors import InvalidInput, MissingAssets
from osfcore.experiments.bench_estimation import BenchEstimate, bench_estimate
from osfcore.objects.asset_library import AssetLibrary
from tests.support.errors import about
from tests.support.oracle import Oracle

CONFIG = BenchEstimate(scenes=1, objects=2, steps=2, size=32)


@pytest.fixture
def oracle(monkeypatch):
    oracle = Oracle()
    oracle.install(monkeypatch, module)
    return oracle


def test_every_kind_of_estimate_is_timed(solids, library, oracle):
    steps = list(bench_estimate(CONFIG, solids, library))
    assert [(step.done, step.report is None) for step in steps] == [(0, True), (0, True), (1, False)]
    assert [what for what, _ in oracle.asked] == ["first search 4", "next", "next", "goal"]
    result = json.loads(json.dumps(steps[-1].report))
    assert all(result[key] > 0 for key in ("first_s", "next_s", "next_s_p90", "goal_s", "threads"))
    assert result["refine_hz"] == pytest.approx(1 / result["next_s"])
    assert (result["scenes"], result["objects"]) == (1, 2)
    assert result["next_s_p90"] >= result["next_s"]


def test_what_cannot_be_measured_is_refused_at_once(solids, library, oracle, tmp_path):
    for wrong, what in (
        ({"scenes": 0}, "number of scenes"),
        ({"steps": 0}, "later frames"),
        ({"objects": 5}, "objects"),
        ({"seed": -1}, "seed"),
    ):
        with pytest.raises(InvalidInput, check=about(what)):
            next(bench_estimate(replace(CONFIG, **wrong), solids, library))
    with pytest.raises(MissingAssets):
        next(bench_estimate(CONFIG, solids, AssetLibrary(tmp_path)))
    assert not oracle.asked
