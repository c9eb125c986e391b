import json

import pytest

from osfcore.experiments.pusht import PlannerReport, PushTEpisode


def episode(planner, seed, coverage, *, seconds=(0.5, 1.5)):
    return PushTEpisode(planner, seed, 0.1, coverage, coverage > 0.95, 2, seconds, (0.01, 0.03))


def test_figures_hold_shares_means_and_tails():
    episodes = [episode("ours", n, c) for n, c in enumerate((0.97, 0.5, 0.96, 0.9))]
    episodes += [episode("other", n, c, seconds=(0.2, 0.2)) for n, c in enumerate((0.2, 0.5, 0.96, 0.1))]
    result = json.loads(json.dumps(PlannerReport(tuple(episodes)).to_json()))
    assert result["tasks"] == 4
    assert result["start_mean"] == pytest.approx(0.1)
    ours, other = result["planners"]["ours"], result["planners"]["other"]
    assert ours["success"] == 0.5
    low, high = ours["success_interval"]
    assert 0 < low < 0.5 < high < 1
    assert ours["coverage_mean"] == pytest.approx(0.8325)
    assert ours["coverage_least"] == 0.5 <= ours["coverage_p10"] <= ours["coverage_median"] == pytest.approx(0.93)
    assert ours["plan_hz"] == pytest.approx(1.0)
    assert ours["plan_s_most"] == 1.5
    assert ours["own_hz"] == pytest.approx(50.0)
    assert other["plan_hz"] == pytest.approx(5.0)
    against = result["against"]["other"]
    assert against["success"]["difference"] == pytest.approx(0.25)
    assert against["coverage"]["difference"] == pytest.approx((0.77 + 0.8) / 4)
    assert [row["seed"] for row in result["episodes"]] == [0, 1, 2, 3] * 2
