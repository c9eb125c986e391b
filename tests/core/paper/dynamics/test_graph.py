import numpy as np
import pytest
import torch

from osfcore.errors import UnknownName
from osfcore.fields.field_library import FieldLibrary
from osfcore.paper.dynamics import (
    NODE_FEATURES,
    PUSHER,
    PUSHER_KAPPA_M,
    Scenes,
    adjacency,
    longest_axes,
    node_features,
    node_numbers,
)
from tests.core.paper.dynamics.scenes import CAN, LONGEST, in_units, scenes

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
