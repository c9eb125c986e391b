"""Dynamics: graph, graph network, prediction, rollout, weights."""

import json

import numpy as np
import pytest
import torch
from safetensors.torch import load, save

from osfcore.dynamics.motion import SUBSTEPS, pusher_path
from osfcore.errors import CorruptFile, InvalidInput, UnknownName
from osfcore.fields.field_library import FieldLibrary
from osfcore.geometry.poses import Pose
from osfcore.geometry.states import SceneState
from osfcore.paper.dynamics import (
    FORMAT,
    LENGTH_M,
    NODE_FEATURES,
    PUSHER,
    PUSHER_KAPPA_M,
    UNKNOWN,
    WEIGHTS_FILE,
    GraphNetwork,
    PaperPushModel,
    Scenes,
    adjacency,
    load_paper_push_model,
    network_bytes,
    node_features,
    read_network,
    shipped,
    squared_error,
    weights_path,
    write_network,
)
from tests.core.paper.scenes import BOX, CAN, KAPPAS, LONGEST, NAMES, network, scenes, state
from tests.support.errors import about

# Graph


FAR = (5.0, 5.0, 0.0)


def pair(distance: float, *, pusher=FAR) -> Scenes:
    """Two objects, one that far from the other along a slanted line."""
    position = torch.zeros(1, 2, 3, dtype=torch.float64)
    position[0, 1] = distance * torch.tensor([0.6, 0.0, 0.8], dtype=torch.float64)
    return Scenes(position, torch.tensor([[[1.0, 0, 0, 0]] * 2]), torch.tensor([pusher], dtype=torch.float64))


def kappas(*values: float) -> torch.Tensor:
    return torch.tensor([values], dtype=torch.float64)


@pytest.mark.parametrize("kappa", [0.04, 0.36])
def test_objects_are_joined_below_the_root_of_the_longest_axis(kappa):
    """The published formula: the squared distance is compared with a length, the larger one of both."""
    root = kappa**0.5
    joined = adjacency(pair(root * (1 - 1e-6)), kappas(kappa, 0.01))
    assert joined[0, 1, 2]
    assert joined[0, 2, 1]
    assert not adjacency(pair(root * (1 + 1e-6)), kappas(kappa, 0.01)).any()


def test_the_pusher_is_joined_as_objects_are_and_edges_go_both_ways_and_none_to_itself():
    assert PUSHER_KAPPA_M == LONGEST
    near, far = (LONGEST**0.5 * (1 + share) for share in (-1e-6, 1e-6))
    for kappa, distance, expected in ((0.01, near, True), (0.01, far, False), (0.25, 0.49, True), (0.25, 0.51, False)):
        found = adjacency(pair(3.0, pusher=(0.0, distance, 0.0)), kappas(kappa, 1e-3))
        assert bool(found[0, 0, 1]) is bool(found[0, 1, 0]) is expected
        assert not found[0, 2].any()
    found = adjacency(scenes(20, 4), torch.rand(20, 4, generator=torch.Generator().manual_seed(0)) * 0.1)
    assert torch.equal(found, found.transpose(1, 2))
    assert not found.diagonal(dim1=1, dim2=2).any()
    assert found.any()


def test_both_quaternions_of_an_orientation_look_the_same():
    given, action = scenes(4, 3), torch.tensor([[0.3, -0.15, 0.0]]).expand(4, -1)
    found = node_features(given, action)
    torch.testing.assert_close(found, node_features(given._replace(quaternion=-given.quaternion), action))
    np.testing.assert_allclose(found[:, 1:, 3:7].abs(), given.quaternion.abs(), atol=1e-12)
    torch.testing.assert_close(found[:, 1:, :3], given.position / LENGTH_M)
    torch.testing.assert_close(found[:, 0, 3:], torch.tensor([[1.0, 0, 0, 0, 1, -0.5, 0]] * 4))
    assert not found[:, 1:, 7:].any()  # the action is the pusher's


# Graph network


def graph(nodes: int = 5, seed: int = 0, share: float = 0.5):
    g = torch.Generator().manual_seed(seed)
    joined = torch.rand(2, nodes, nodes, generator=g) < share
    joined = (joined | joined.transpose(1, 2)) & ~torch.eye(nodes, dtype=torch.bool)
    number = torch.randint(len(NAMES) + 2, (2, nodes), generator=g)
    return torch.randn(2, nodes, NODE_FEATURES, generator=g), number, joined


@pytest.mark.parametrize("steps", [1, 2, 3])
def test_effects_travel_one_edge_a_step_after_the_first(steps):
    """A chain 0 - 1 - 2 - 3 - 4: what node 0 receives reaches as many nodes as there are steps."""
    features, number, joined = graph(share=0.0)
    for node in range(4):
        joined[:, node, node + 1] = joined[:, node + 1, node] = True
    net = network(steps=steps, hidden=64)
    changed = torch.cat([features[:, :1] + 1, features[:, 1:]], dim=1)
    felt = (net(changed, number, joined) != net(features, number, joined)).any(dim=2).any(dim=0)
    assert felt.tolist() == [node <= steps for node in range(5)]


def test_names_are_numbered_and_unknown_ones_have_no_embedding_even_in_training():
    net = network()
    assert len({net.number(CAN), net.number(BOX), UNKNOWN, PUSHER}) == 4
    assert net.number("teapot") == UNKNOWN
    assert not net.embedding(torch.tensor(UNKNOWN)).any()
    features, number, joined = graph()
    net(features, torch.zeros_like(number), joined).square().sum().backward()
    assert not net.embedding.weight.grad[UNKNOWN].any()


# Prediction


def test_the_loss_is_the_squared_error_summed_across_objects():
    given = scenes(4, 3)
    assert squared_error(given, given.position, given.quaternion) == 0
    assert squared_error(given, given.position, -given.quaternion) == 0  # the same orientations
    shifted = given.position + torch.tensor([0.03, 0.0, 0.04])
    expected = torch.tensor(3 * (0.05 / LENGTH_M) ** 2)
    torch.testing.assert_close(squared_error(given, shifted, given.quaternion), expected)
    still = torch.zeros(1, 1, 3)
    upright, turned = torch.tensor([[[1.0, 0, 0, 0]]]), torch.tensor([[[0.0, 0, 0, 1.0]]])  # half a turn apart
    begin = scenes(1, 1)._replace(position=still, quaternion=upright)
    torch.testing.assert_close(squared_error(begin, still, turned), torch.tensor(2.0))


# Rollout


KNOWN = {**KAPPAS, "teapot": 0.2}


@pytest.fixture(scope="module")
def model():
    return PaperPushModel(network(), KNOWN)


def plans(count: int, horizon: int = 4, seed: int = 0) -> np.ndarray:
    velocity = np.random.default_rng(seed).uniform(-0.3, 0.3, (count, horizon, 2))
    return np.concatenate([velocity, np.zeros((count, horizon, 1))], axis=2)


def test_rollouts_begin_at_the_state_and_the_pusher_goes_its_path(model):
    begin, actions = state(), plans(3)
    found = model.rollout(begin, actions)
    assert found.names == NAMES
    assert np.all(found.positions[:, 0] == begin.poses.position)
    assert np.all(found.quaternions[:, 0] == begin.poses.quaternion)
    np.testing.assert_allclose(np.linalg.norm(found.quaternions, axis=-1), 1, atol=1e-9)
    path = pusher_path(begin.pusher[:2], actions[..., :2])[:, ::SUBSTEPS]
    np.testing.assert_array_equal(found.pusher[..., :2], path)
    assert np.all(found.pusher[..., 2] == begin.pusher[2])


def test_the_order_of_objects_never_matters(model):
    begin = state(names=(CAN, BOX, "teapot"))
    names = ("teapot", CAN, BOX)
    here, there = (model.rollout(s, plans(3)) for s in (begin, begin.reordered(names)))
    assert there.names == names
    np.testing.assert_array_equal(there.positions, here.positions[:, :, [2, 0, 1]])
    np.testing.assert_array_equal(there.quaternions, here.quaternions[:, :, [2, 0, 1]])


def test_sequences_do_not_depend_on_their_neighbours(model):
    actions = plans(520, 1)
    many = model.rollout(state(), actions)
    for k in (0, 511, 512):
        alone = model.rollout(state(), actions[k : k + 1])
        np.testing.assert_allclose(alone.positions[0], many.positions[k], atol=1e-6)
        np.testing.assert_allclose(alone.quaternions[0], many.quaternions[k], atol=1e-6)


def test_a_network_that_has_learned_nothing_predicts_that_nothing_moves():
    begin = state()
    before = SceneState(begin.names, Pose(begin.poses.position - 0.03, begin.poses.quaternion), begin.light, None)
    found = PaperPushModel(GraphNetwork(NAMES, 8), KAPPAS).rollout(begin, plans(2), before)
    np.testing.assert_allclose(found.positions, np.broadcast_to(begin.poses.position, found.positions.shape), atol=1e-7)


def test_the_shipped_model_moves_what_is_pushed_more_than_what_is_not():
    shipped = load_paper_push_model(None, FieldLibrary(None), NAMES)
    begin = state()
    toward = np.array([[[0.3, 0.0, 0.0]] * 2])
    pushed, left = (shipped.rollout(begin, actions).positions for actions in (toward, 0 * toward))
    assert pushed[0, -1, 0, 0] - left[0, -1, 0, 0] > 0.01
    assert np.linalg.norm(left[0, -1] - left[0, 0], axis=-1).max() < 0.02


def test_what_cannot_be_predicted_is_refused(model):
    with pytest.raises(InvalidInput, check=about("number of objects")):
        model.rollout(state(names=()), plans(1))
    with pytest.raises(UnknownName, check=about("kettle")):
        model.rollout(state(names=(CAN, "kettle")), plans(1))
    with pytest.raises(InvalidInput, check=about("pusher of the state")):
        model.rollout(SceneState(NAMES, state().poses, state().light, None), plans(1))
    with pytest.raises(InvalidInput, check=about("action")):
        model.rollout(state(), np.full((1, 1, 3), [0.31, 0, 0]))
    with pytest.raises(InvalidInput, check=about("number of objects")):
        PaperPushModel(network(), {})


def test_a_network_of_this_machine_comes_first_and_is_loaded_for_the_objects_asked_for(tmp_path):
    assert weights_path(None) == weights_path(tmp_path) == shipped()
    own = tmp_path / "dynamics" / WEIGHTS_FILE
    write_network(own, network())
    assert weights_path(tmp_path) == own
    assert load_paper_push_model(tmp_path, FieldLibrary(None), [BOX, CAN]).names == (CAN, BOX)
    with pytest.raises(UnknownName, check=about("teapot")):
        load_paper_push_model(tmp_path, FieldLibrary(None), ["teapot"])
    own.write_bytes(b"broken")
    with pytest.raises(CorruptFile, check=about(WEIGHTS_FILE)):
        load_paper_push_model(tmp_path, FieldLibrary(None), [CAN])


# Weights


def repacked(meta=None, **tensors) -> bytes:
    """The file of a network with some tensors or words changed; None leaves one out."""
    content = load(network_bytes(network())) | tensors
    words = {"format": FORMAT, "hidden": "16", "steps": "2", "names": json.dumps(NAMES)} | (meta or {})
    kept = {name: value for name, value in content.items() if value is not None}
    return save(kept, {name: word for name, word in words.items() if word is not None})


def test_a_round_trip_loses_no_more_than_half_precision(tmp_path):
    original = network(hidden=12, steps=3)
    write_network(tmp_path / "a.safetensors", original)
    back = read_network(tmp_path / "a.safetensors")
    assert (back.hidden, back.steps, back.names, back.training) == (12, 3, NAMES, False)
    for name, value in original.state_dict().items():
        torch.testing.assert_close(back.state_dict()[name], value, rtol=2**-10, atol=1e-7)


def test_files_that_hold_no_network_are_refused(tmp_path):
    path = tmp_path / "a.safetensors"
    for reason, files in {
        FORMAT: (repacked({"format": "pushes-2"}),),
        "no network": (repacked({"names": "["}), repacked({"names": "[" * 100_000})),
        "names of objects": (repacked({"names": '["a", 7]'}), repacked({"names": '["a", "a"]'})),
        "do not fit": (repacked({"names": '["a"]'}),),
        "unknown objects": (repacked(**{"embedding.weight": torch.ones(4, 16)}),),
    }.items():
        for data in files:
            path.write_bytes(data)
            with pytest.raises(CorruptFile, check=about(reason)) as caught:
                read_network(path)
            assert caught.value.path == str(path)


def test_the_shipped_network_is_small_whole_and_described():
    assert shipped().stat().st_size < 1_000_000
    assert set(read_network(shipped()).names) == set(FieldLibrary(None).names())
    known = json.loads(shipped().with_suffix(".json").read_text())
    assert known["command"].startswith("osf train dynamics --method paper")
    assert known["validation_mm_4"] < known["validation_constant_mm_4"]
    assert known["bytes"] == shipped().stat().st_size
