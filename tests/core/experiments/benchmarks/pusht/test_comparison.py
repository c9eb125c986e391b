import pytest
import torch

from osfcore.errors import InvalidInput
from osfcore.experiments.pusht import BenchPlanner, bench_planner


@pytest.mark.parametrize(
    "change", [{"tasks": 0}, {"samples": 18}, {"horizon": 0}, {"steps": 0}, {"seed": -1}, {"horizon": 201}]
)
def test_settings_out_of_range_are_refused(change):
    with pytest.raises(InvalidInput):
        BenchPlanner(**change)


def test_three_planners_do_the_same_tasks():
    pytest.importorskip("gym_pusht")
    pytest.importorskip("pytorch_mppi")
    config = BenchPlanner(tasks=2, samples=20, horizon=3, steps=2, seed=5)
    before = torch.random.get_rng_state()
    steps = list(bench_planner(config))
    assert torch.equal(before, torch.random.get_rng_state())
    assert [step.done for step in steps] == [0, *range(6), 6]
    assert all(step.total == 6 for step in steps)
    report = steps[-1].report
    assert [(e.planner, e.seed) for e in report.episodes] == [
        (name, seed) for seed in (5, 6) for name in ("ours", "paper", "pytorch_mppi")
    ]
    for episode in report.episodes:
        assert episode.coverage >= episode.start
        assert len(episode.plan_s) == len(episode.own_s) == episode.steps == 2
        assert min(episode.plan_s + episode.own_s) > 0
    assert len({e.start for e in report.episodes if e.seed == 5}) == 1
    *_, again = bench_planner(config)
    assert [e.coverage for e in again.report.episodes] == [e.coverage for e in report.episodes]
