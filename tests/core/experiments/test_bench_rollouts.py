import numpy as np

from osfcore.dynamics.graph import PropagationNetwork
from osfcore.dynamics.rollout import PushModel
from osfcore.experiments import bench_rollouts as bench_dynamics
from osfcore.experiments.bench_rollouts import bench_rollouts, rollout_rate
from tests.core.experiments.pushes import shapes


def test_rollouts_are_timed_in_a_scene_where_most_paths_meet_something(monkeypatch):
    monkeypatch.setattr(bench_dynamics, "SEQUENCES", 40)
    monkeypatch.setattr(bench_dynamics, "_REPEATS", 1)
    costs = bench_rollouts(PropagationNetwork(8, 1), shapes())
    assert costs.rollout_s > 0
    assert np.isclose(costs.rollout_steps_per_s, 400 / costs.rollout_s)
    assert costs.touched_share > 0.3
    assert rollout_rate(PushModel(PropagationNetwork(8, 1), shapes()), shapes()) > 0
