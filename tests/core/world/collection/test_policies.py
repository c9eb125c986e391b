import numpy as np
import pytest

from osfcore.geometry.workspace import MAX_SPEED_M_S, check_action
from osfcore.world.collect_pushes import DirectedPolicy, PaperPolicy
from osfcore.world.scenes import SceneRequest
from osfcore.world.tabletop import Tabletop


def run(library, policy_name: str, seeds: range) -> float:
    """Share of steps with contact; every action is checked on the way."""
    world = Tabletop(library, request=SceneRequest(count=3))
    contacts = []
    for seed in seeds:
        world.arrange(seed)
        rng = np.random.default_rng(seed)
        policy = PaperPolicy(rng) if policy_name == "paper" else DirectedPolicy(world.assets, rng)
        for _ in range(50):
            action = check_action(policy.action(world.truth()))
            contacts.append(bool(world.act_contacts(action)))
    world.close()
    return float(np.mean(contacts))


@pytest.mark.slow
def test_directed_policy_has_sustained_contact_where_the_paper_policy_rarely_has(library):
    paper, directed = run(library, "paper", range(8)), run(library, "directed", range(8))
    assert directed > 0.4
    assert directed > 2 * paper


def test_paper_policy_is_uniform_in_the_speed_limits(library):
    policy = PaperPolicy(np.random.default_rng(0))
    world = Tabletop(library)
    world.arrange(0)
    actions = np.array([policy.action(world.truth()) for _ in range(4000)])
    world.close()
    np.testing.assert_array_equal(actions[:, 2], 0)
    assert np.abs(actions).max() <= MAX_SPEED_M_S
    for axis in (0, 1):  # quartiles of a uniform distribution
        np.testing.assert_allclose(np.quantile(actions[:, axis], [0.25, 0.5, 0.75]), [-0.15, 0, 0.15], atol=0.015)


def test_policy_without_pusher_is_a_programming_error(library):
    world = Tabletop(library)
    world.arrange(0)
    state = world.truth()
    bare = type(state)(state.names, state.poses, state.light, None)
    with pytest.raises(ValueError, match="pusher"):
        DirectedPolicy(world.assets, np.random.default_rng(0)).action(bare)
    world.close()
