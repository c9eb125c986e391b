"""Dynamics: graph, graph network, prediction, rollout, weights."""

import json

import numpy as np
import pytest
import torch
from safetensors.torch import load, save

from osfcore.dynamics.motion import SUBSTEPS, pusher_path
from osfcore.errors import CannotWrite, CorruptFile, InvalidInput, UnknownName
from osfcore.fields.field_library import FieldLibrary
from osfcore.geometry.poses import Pose
from osfcore.geometry.states import SceneState
from osfcore.paper.dynamics import (
    FORMAT,
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
    longest_axes,
    network_bytes,
    node_features,
    node_numbers,
    read_network,
    shipped,
    squared_error,
    unroll,
    weights_path,
    write_network,
)
from tests.core.paper.scenes import BOX, CAN, KAPPAS, LONGEST, NAMES, in_units, network, scenes, state

# Graph


FAR = (5.0, 5.0, 0.0)


def pair(distance: float, *, pusher=FAR) -> Scenes:
    """Two objects, one that far from the other along a slanted line."""
    position = torch.zeros(1, 2, 3, dtype=torch.float64)
    position[0, 1] = distance * torch.tensor([0.6, 0.0, 0.8], dtype=torch.float64)
    return Scenes(position, torch.tensor([[[1.0, 0, 0, 0]] * 2]), torch.tensor([pusher], dtype=torch.float64))


def kappas(*values: float) -> torch.Tensor:
    return torch.tensor([values], dtype=torch.float64)


@pytest.mark.parametrize("kappa", [0.04, 0.25, 0.36])
def test_objects_are_joined_below_the_root_of_the_longest_axis(kappa):
    """The published formula: the squared distance is compared with a length."""
    root = kappa**0.5
    assert adjacency(pair(root * (1 - 1e-6)), kappas(kappa, kappa))[0, 1, 2]
    assert not adjacency(pair(root * (1 + 1e-6)), kappas(kappa, kappa)).any()


def test_the_longer_one_of_two_objects_decides_for_both():
    found = adjacency(pair(0.5), kappas(0.01, 0.26))
    assert found[0, 1, 2]
    assert found[0, 2, 1]
    assert not adjacency(pair(0.5), kappas(0.01, 0.24)).any()


def test_the_pusher_is_joined_as_objects_are():
    assert PUSHER_KAPPA_M == LONGEST
    near, far = (LONGEST**0.5 * (1 + share) for share in (-1e-6, 1e-6))
    for kappa, distance, expected in ((0.01, near, True), (0.01, far, False), (0.25, 0.49, True), (0.25, 0.51, False)):
        found = adjacency(pair(3.0, pusher=(0.0, distance, 0.0)), kappas(kappa, 1e-3))
        assert bool(found[0, 0, 1]) is bool(found[0, 1, 0]) is expected
        assert not found[0, 2].any()


@pytest.mark.parametrize("seed", range(3))
def test_edges_go_both_ways_and_none_to_itself(seed):
    found = adjacency(scenes(20, 4, seed), torch.rand(20, 4, generator=torch.Generator().manual_seed(seed)) * 0.1)
    assert torch.equal(found, found.transpose(1, 2))
    assert not found.diagonal(dim1=1, dim2=2).any()
    assert found.any()


def test_longest_axes_are_those_of_the_fields():
    library = FieldLibrary(None)
    found = longest_axes(library, [CAN, "003_cracker_box"])
    low, high = library.load(CAN).extent
    assert found[CAN] == pytest.approx(max(high - low))
    assert 0.06 < found[CAN] < 0.12 < found["003_cracker_box"] < 0.25
    with pytest.raises(UnknownName, match="teapot"):
        longest_axes(library, ["teapot"])


def test_nodes_are_poses_and_the_action_is_the_pushers():
    given = scenes(3, 2)
    action = torch.tensor([[0.3, -0.15, 0.0]]).expand(3, -1)
    found = node_features(given, action)
    assert found.shape == (3, 3, NODE_FEATURES)
    torch.testing.assert_close(found[:, 0, :3], given.pusher * in_units(1))
    torch.testing.assert_close(found[:, 1:, :3], given.position * in_units(1))
    torch.testing.assert_close(found[:, 0, 3:], torch.tensor([[1.0, 0, 0, 0, 1, -0.5, 0]] * 3))
    assert not found[:, 1:, 7:].any()


def test_both_quaternions_of_an_orientation_look_the_same():
    given = scenes(4, 3)
    action = torch.zeros(4, 3)
    found = node_features(given, action)
    torch.testing.assert_close(found, node_features(given._replace(quaternion=-given.quaternion), action))
    assert (found[..., 3] >= 0).all()
    np.testing.assert_allclose(found[:, 1:, 3:7].abs(), given.quaternion.abs(), atol=1e-12)


def test_the_first_node_is_the_pusher():
    assert node_numbers(torch.tensor([[4, 0], [2, 3]])).tolist() == [[PUSHER, 4, 0], [PUSHER, 2, 3]]


# Graph network


def graph(nodes: int = 5, seed: int = 0, share: float = 0.5):
    g = torch.Generator().manual_seed(seed)
    joined = torch.rand(2, nodes, nodes, generator=g) < share
    joined = (joined | joined.transpose(1, 2)) & ~torch.eye(nodes, dtype=torch.bool)
    number = torch.randint(len(NAMES) + 2, (2, nodes), generator=g)
    return torch.randn(2, nodes, NODE_FEATURES, generator=g), number, joined


@pytest.mark.parametrize("seed", range(3))
def test_permuting_nodes_permutes_the_answer(seed):
    features, number, joined = graph(seed=seed)
    order = torch.randperm(5, generator=torch.Generator().manual_seed(seed))
    answer = network()(features, number, joined)
    other = network()(features[:, order], number[:, order], joined[:, order][:, :, order])
    torch.testing.assert_close(other, answer[:, order], atol=1e-5, rtol=0)


def test_before_anything_is_learned_nothing_moves():
    assert not GraphNetwork(NAMES, 8)(*graph()).any()


def test_what_is_not_joined_is_not_felt():
    features, number, joined = graph()
    joined[:, 0], joined[:, :, 0] = False, False
    answer = network()(features, number, joined)
    other = network()(torch.cat([features[:, :1] + 1, features[:, 1:]], dim=1), number, joined)
    torch.testing.assert_close(other[:, 1:], answer[:, 1:], atol=0, rtol=0)
    assert (other[:, 0] != answer[:, 0]).any()


@pytest.mark.parametrize("steps", [1, 2, 3])
def test_effects_travel_one_edge_a_step_after_the_first(steps):
    """A chain 0 - 1 - 2 - 3 - 4: what node 0 is told reaches as many nodes as there are steps."""
    features, number, joined = graph(share=0.0)
    for node in range(4):
        joined[:, node, node + 1] = joined[:, node + 1, node] = True
    net = network(steps=steps, hidden=64)
    changed = torch.cat([features[:, :1] + 1, features[:, 1:]], dim=1)
    felt = (net(changed, number, joined) != net(features, number, joined)).any(dim=2).any(dim=0)
    assert felt.tolist() == [node <= steps for node in range(5)]


def test_names_are_numbered_and_unknown_ones_have_no_embedding():
    net = network()
    assert len({net.number(CAN), net.number(BOX), 0, 1}) == 4
    assert net.number("teapot") == UNKNOWN
    assert not net.embedding(torch.tensor(net.number("teapot"))).any()
    assert net.embedding(torch.tensor(net.number(CAN))).any()


def test_the_embedding_of_the_unknown_stays_zero_in_training():
    net = network()
    features, number, joined = graph()
    net(features, torch.zeros_like(number), joined).square().sum().backward()
    assert net.embedding.weight.grad is not None
    assert not net.embedding.weight.grad[UNKNOWN].any()


def test_all_objects_edges_and_steps_share_their_weights():
    def count(names, steps):
        return sum(p.numel() for p in network(names=names, steps=steps).parameters())

    assert count(NAMES, 1) == count(NAMES, 5)
    assert count((*NAMES, "teapot"), 1) == count(NAMES, 1) + 16


# Prediction


NUMBER, KAPPA = torch.tensor([[2, 3, 0]] * 4), torch.tensor([[0.1, 0.2, 0.05]] * 4)


def rolled(net, given, *, number=NUMBER, kappa=KAPPA, steps=3, seed=0):
    g = torch.Generator().manual_seed(seed)
    actions = torch.rand(4, steps, 3, generator=g) * 0.6 - 0.3
    pusher = torch.cat([given.pusher[:, None], torch.rand(4, steps, 3, generator=g)], dim=1)
    with torch.inference_mode():
        return list(unroll(net, number, kappa, given, actions, pusher)), pusher


def test_quaternions_stay_unit_and_the_pusher_goes_its_way():
    found, pusher = rolled(network(), scenes(4, 3), steps=20)
    assert len(found) == 20
    for step, after in enumerate(found, start=1):
        torch.testing.assert_close(after.quaternion.norm(dim=-1), torch.ones(4, 3))
        torch.testing.assert_close(after.pusher, pusher[:, step])


def test_what_has_learned_nothing_moves_nothing():
    given = scenes(4, 3)
    for after in rolled(GraphNetwork(NAMES, 8), given)[0]:
        torch.testing.assert_close(after.position, given.position)
        cosine = (after.quaternion * given.quaternion).sum(dim=-1).abs()
        torch.testing.assert_close(cosine, torch.ones_like(cosine))


def test_a_quaternion_and_its_opposite_move_the_same_way():
    given = scenes(4, 3)
    one, other = (rolled(network(), g)[0][-1] for g in (given, given._replace(quaternion=-given.quaternion)))
    torch.testing.assert_close(one, other)


@pytest.mark.parametrize("order", [[1, 0, 2], [2, 0, 1], [2, 1, 0]])
def test_the_order_of_objects_does_not_matter(order):
    given = scenes(4, 3)
    other = given._replace(position=given.position[:, order], quaternion=given.quaternion[:, order])
    here = rolled(network(), given)[0][-1]
    there = rolled(network(), other, number=NUMBER[:, order], kappa=KAPPA[:, order])[0][-1]
    torch.testing.assert_close(there.position, here.position[:, order], atol=1e-5, rtol=0)
    torch.testing.assert_close(there.quaternion, here.quaternion[:, order], atol=1e-5, rtol=0)


def test_what_objects_are_called_and_how_long_they_are_matters():
    given, net = scenes(4, 3), network()
    plain = rolled(net, given)[0][0]
    assert (rolled(net, given, number=NUMBER[:, [1, 0, 2]])[0][0].position != plain.position).any()
    assert (rolled(net, given, kappa=0 * KAPPA)[0][0].position != plain.position).any()


def test_the_loss_is_the_squared_error_summed_across_objects():
    given = scenes(4, 3)
    assert squared_error(given, given.position, given.quaternion) == 0
    assert squared_error(given, given.position, -given.quaternion) == 0  # the same orientations
    shifted = given.position + torch.tensor([0.03, 0.0, 0.04])
    expected = torch.tensor(3 * in_units(0.05) ** 2)
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


def test_shapes_and_beginnings(model):
    begin, actions = state(), plans(5)
    found = model.rollout(begin, actions)
    assert (found.names, model.names) == (NAMES, tuple(sorted(KNOWN)))
    assert found.positions.shape == (5, 5, 2, 3)
    assert found.quaternions.shape == (5, 5, 2, 4)
    np.testing.assert_array_equal(found.positions[:, 0], np.stack([begin.poses.position] * 5))
    np.testing.assert_array_equal(found.quaternions[:, 0], np.stack([begin.poses.quaternion] * 5))
    np.testing.assert_allclose(np.linalg.norm(found.quaternions, axis=-1), 1, atol=1e-9)
    path = pusher_path(begin.pusher[:2], actions[..., :2])[:, ::SUBSTEPS]
    np.testing.assert_array_equal(found.pusher[..., :2], path)
    np.testing.assert_array_equal(found.pusher[..., 2], np.full((5, 5), begin.pusher[2]))


def test_the_order_of_objects_never_matters(model):
    begin = state(names=(CAN, BOX, "teapot"))
    names = ("teapot", CAN, BOX)
    here, there = (model.rollout(s, plans(3)) for s in (begin, begin.reordered(names)))
    assert there.names == names
    np.testing.assert_array_equal(there.positions, here.positions[:, :, [2, 0, 1]])
    np.testing.assert_array_equal(there.quaternions, here.quaternions[:, :, [2, 0, 1]])


def test_sequences_do_not_depend_on_their_neighbours(model):
    actions = plans(600, 2)
    many = model.rollout(state(), actions)
    for k in (0, 511, 512, 599):
        alone = model.rollout(state(), actions[k : k + 1])
        np.testing.assert_allclose(alone.positions[0], many.positions[k], atol=1e-6)
        np.testing.assert_allclose(alone.quaternions[0], many.quaternions[k], atol=1e-6)


def test_what_the_pusher_does_far_away_is_not_felt(model):
    begin = state(pusher=(-0.34, -0.34))
    still = model.rollout(begin, np.zeros((1, 1, 3)))
    pushed = model.rollout(begin, np.array([[[-0.3, -0.3, 0.0]]]))
    np.testing.assert_array_equal(pushed.positions, still.positions)
    near = model.rollout(state(), np.array([[[-0.3, -0.3, 0.0]]]))
    assert (near.positions != model.rollout(state(), np.zeros((1, 1, 3))).positions).any()


def test_a_network_that_has_learned_nothing_predicts_that_nothing_moves():
    begin = state()
    found = PaperPushModel(GraphNetwork(NAMES, 8), KAPPAS).rollout(begin, plans(2))
    np.testing.assert_allclose(found.positions, np.broadcast_to(begin.poses.position, found.positions.shape), atol=1e-7)


def test_what_was_before_plays_no_part(model):
    begin = state()
    before = SceneState(begin.names, Pose(begin.poses.position - 0.03, begin.poses.quaternion), begin.light, None)
    np.testing.assert_array_equal(
        model.rollout(begin, plans(2), before).positions, model.rollout(begin, plans(2)).positions
    )


def test_objects_that_the_network_never_met_are_predicted(model):
    begin = state(names=("teapot", CAN))
    assert np.isfinite(model.rollout(begin, plans(2)).positions).all()


def test_the_shipped_model_moves_what_is_pushed_more_than_what_is_not():
    shipped = load_paper_push_model(None, FieldLibrary(None), NAMES)
    begin = state()
    toward = np.array([[[0.3, 0.0, 0.0]] * 2])
    pushed, left = (shipped.rollout(begin, actions).positions for actions in (toward, 0 * toward))
    assert pushed[0, -1, 0, 0] - left[0, -1, 0, 0] > 0.01
    assert np.linalg.norm(left[0, -1] - left[0, 0], axis=-1).max() < 0.02


def test_mistakes_are_told(model):
    with pytest.raises(InvalidInput, match="number of objects is 0"):
        model.rollout(state(names=()), plans(1))
    with pytest.raises(UnknownName, match="kettle"):
        model.rollout(state(names=(CAN, "kettle")), plans(1))
    unseen = SceneState(NAMES, state().poses, state().light, None)
    with pytest.raises(InvalidInput, match="pusher of the state"):
        model.rollout(unseen, plans(1))
    with pytest.raises(InvalidInput, match=r"0\.3"):
        model.rollout(state(), np.full((1, 1, 3), [0.31, 0, 0]))
    with pytest.raises(InvalidInput, match="number of objects is 0"):
        PaperPushModel(network(), {})


def test_a_model_is_loaded_for_the_objects_asked_for(tmp_path):
    own = tmp_path / "dynamics" / WEIGHTS_FILE
    write_network(own, network())
    model = load_paper_push_model(tmp_path, FieldLibrary(None), [BOX, CAN])
    assert model.names == (CAN, BOX)
    assert model.rollout(state(), plans(1)).positions.shape == (1, 5, 2, 3)
    with pytest.raises(UnknownName, match="teapot"):
        load_paper_push_model(tmp_path, FieldLibrary(None), ["teapot"])
    own.write_bytes(b"broken")
    with pytest.raises(CorruptFile, match=WEIGHTS_FILE):
        load_paper_push_model(tmp_path, FieldLibrary(None), [CAN])


# Weights


BIAS = "answer.bias"


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
    assert (back.hidden, back.steps, back.names) == (12, 3, NAMES)
    assert not back.training
    for name, value in original.state_dict().items():
        torch.testing.assert_close(back.state_dict()[name], value, rtol=2**-10, atol=1e-7)
    again, first = load(network_bytes(back)), load((tmp_path / "a.safetensors").read_bytes())
    assert all(torch.equal(again[name], first[name]) for name in first)  # and nothing more the second time


@pytest.mark.parametrize(
    ("data", "words"),
    [
        (lambda: b"", "no network"),
        (lambda: network_bytes(network())[:100], "no network"),
        (lambda: network_bytes(network())[:-1], "no network"),
        (lambda: repacked({"format": "pushes-2"}), f"not of the format {FORMAT}"),
        (lambda: repacked({"format": None}), f"not of the format {FORMAT}"),
        (lambda: repacked({"hidden": None}), "no network"),
        (lambda: repacked({"hidden": "many"}), "no network"),
        (lambda: repacked({"names": "["}), "no network"),
        (lambda: repacked({"names": "[" * 100_000}), "no network"),
        (lambda: repacked({"hidden": "1000000"}), "out of range"),
        (lambda: repacked({"steps": "0"}), "out of range"),
        (lambda: repacked({"names": "7"}), "names of objects"),
        (lambda: repacked({"names": '["a", 7]'}), "names of objects"),
        (lambda: repacked({"names": '["a", "a"]'}), "names of objects"),
        (lambda: repacked({"names": '["a"]'}), "do not fit"),
        (lambda: repacked({"hidden": "17"}), "do not fit"),
        (lambda: repacked(**{BIAS: None}), "do not fit"),
        (lambda: repacked(more=torch.zeros(7)), "do not fit"),
        (lambda: repacked(**{BIAS: torch.full((7,), float("nan"))}), "not all finite"),
        (lambda: repacked(**{"embedding.weight": torch.ones(4, 16)}), "unknown objects is not zero"),
    ],
)
def test_files_that_hold_no_network_are_told_in_one_sentence(tmp_path, data, words):
    path = tmp_path / "a.safetensors"
    path.write_bytes(data())
    with pytest.raises(CorruptFile, match=words) as caught:
        read_network(path)
    assert "a.safetensors" in str(caught.value)
    assert "\n" not in str(caught.value)


def test_places_that_cannot_be_read_or_written_are_told(tmp_path):
    with pytest.raises(CorruptFile):
        read_network(tmp_path / "nowhere.safetensors")
    (tmp_path / "file").write_text("")
    with pytest.raises(CannotWrite):
        write_network(tmp_path / "file" / "a.safetensors", network())


def test_the_shipped_network_is_small_whole_and_described():
    assert shipped().stat().st_size < 1_000_000
    assert set(read_network(shipped()).names) == set(FieldLibrary(None).names())
    told = json.loads(shipped().with_suffix(".json").read_text())
    assert told["command"].startswith("osf train dynamics --method paper")
    assert told["validation_mm_4"] < told["validation_constant_mm_4"]
    assert told["bytes"] == shipped().stat().st_size


def test_a_network_of_this_machine_comes_first(tmp_path):
    assert weights_path(None) == weights_path(tmp_path) == shipped()
    own = tmp_path / "dynamics" / "paper_pushes.safetensors"
    write_network(own, network())
    assert weights_path(tmp_path) == own
