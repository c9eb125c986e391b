import pytest

from osfcore.dynamics.graph import PropagationNetwork
from osfcore.dynamics.rollout import PushModel
from osfcore.experiments import bench_rollouts as module
from osfcore.experiments.bench_rollouts import bench_rollouts
from tests.support.push_episodes import shapes


def test_rollouts_are_timed_in_a_scene_where_most_paths_meet_something(monkeypatch):
    monkeypatch.setattr(module, "SEQUENCES", 40)
    costs = bench_rollouts(PushModel(PropagationNetwork(8, 1), shapes()), shapes())
    assert costs.rollout_steps_per_s == pytest.approx(400 / costs.rollout_s)
    assert costs.touched_share > 0.3
