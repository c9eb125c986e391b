import numpy as np
import pytest
import torch

from osfcore.dynamics.graph import build_graph
from osfcore.dynamics.motion import Sweep, headings
from osfcore.dynamics.network import MOTION
from osfcore.dynamics.pusher import SUBSTEPS
from osfcore.dynamics.samples import _motion, samples
from osfcore.dynamics.step import advance
from osfcore.dynamics.windows import batch, record
from tests.core.dynamics.scenes import CAN, GELATIN, episode, network, scene


@pytest.fixture(scope="module")
def recording(shapes):
    """A can pushed into a box, twice."""
    begins = [scene(shapes, {CAN: (0.06, y, (0, 0, 0.3)), GELATIN: (0.15, 0.0, (0, 0, 1.0))}) for y in (0.0, 0.01)]
    actions = np.tile([0.3, 0.05, 0.0], (5, 1))
    return record([episode(shapes, begin, actions) for begin in begins], shapes, 1)


@pytest.fixture(scope="module")
def drawn(recording, table):
    return samples(recording, table)


def test_every_substep_in_which_something_can_move_is_a_graph(drawn):
    assert 10 < len(drawn) <= 2 * 5 * SUBSTEPS
    everything = drawn.draw(torch.arange(len(drawn)), torch.zeros(len(drawn), dtype=torch.bool))
    assert len(everything.nodes) == len(drawn.nodes.values)
    assert len(everything.edges) == len(everything.receiver) >= len(everything.sender) > 0
    assert everything.target.shape == (len(everything.nodes), MOTION)
    assert everything.receiver.max() < len(everything.nodes)


def test_what_answers_the_targets_makes_what_was_recorded(recording, drawn, table):
    """One substep of a window with the target for an answer ends where the recording does."""
    graph = 0
    for number in range(len(recording.starts)):
        pieces = batch(recording, table, np.array([number]))
        motion = pieces.motion
        first = recording.starts[number][1] * SUBSTEPS
        path = recording.pusher[recording.starts[number][0]]
        sweep = Sweep(headings(pieces.velocity[0], motion), (path[first + 1] - path[first])[None])
        target = drawn.draw(torch.tensor([graph]), torch.zeros(1, dtype=torch.bool)).target

        def answer(nodes, *_, target=target):
            assert len(nodes) == len(target)
            return target

        after = advance(answer, table, pieces.number, motion, sweep)
        moved = (after.linear.abs().amax(dim=2) > 0)[0]
        error = (after.centre - pieces.targets.centre[0])[0][moved].norm(dim=1)
        assert (error < 2e-5).all()
        # the graphs of the window's four substeps, where it has them
        graph += sum(_has_graph(recording, table, number, k) for k in range(SUBSTEPS))
    assert graph == len(drawn)


def _has_graph(recording, table, number: int, substep: int) -> bool:
    e, first = recording.starts[number]
    at = torch.tensor([first * SUBSTEPS + substep])
    motion, shape = _motion(recording, torch.tensor([e]), at)
    shift = recording.pusher[[e], at + 1] - motion.pusher
    return (
        len(build_graph(table, shape, motion, Sweep(headings(recording.velocity[[e], first], motion), shift)).scene) > 0
    )


def test_graphs_drawn_together_answer_as_they_do_alone(drawn):
    net, numbers = network(), torch.tensor([3, 7, 3, len(drawn) - 1])
    flipped = torch.tensor([False, True, True, False])

    def answers(which, flags):
        sample = drawn.draw(which, flags)
        return net(sample.nodes, sample.edges, sample.receiver, sample.sender), sample.target

    with torch.no_grad():
        together, targets = answers(numbers, flipped)
        alone = [answers(numbers[k : k + 1], flipped[k : k + 1]) for k in range(len(numbers))]
    torch.testing.assert_close(together, torch.cat([a for a, _ in alone]), atol=1e-5, rtol=1e-5)
    torch.testing.assert_close(targets, torch.cat([t for _, t in alone]))
