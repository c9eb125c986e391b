from dataclasses import replace

import numpy as np
import pytest
import torch

from osfcore.dynamics.graph import MOTION, advance, build_graph
from osfcore.dynamics.motion import SUBSTEPS, Sweep, headings, sleeping, substates
from osfcore.dynamics.train import batch, disturbed_substeps, record, samples, turn_between
from osfcore.geometry.poses import quaternion_conjugate, quaternion_log, quaternion_multiply
from osfcore.io.push_file import Disturbed
from tests.core.dynamics.scenes import CAN, GELATIN, episode, network, scene


@pytest.fixture(scope="module")
def begun(shapes):
    """A can pushed into a box, twice."""
    begins = [scene(shapes, {CAN: (0.06, y, (0, 0, 0.3)), GELATIN: (0.15, 0.0, (0, 0, 1.0))}) for y in (0.0, 0.01)]
    actions = np.tile([0.3, 0.05, 0.0], (5, 1))
    return [episode(shapes, begin, actions) for begin in begins]


@pytest.fixture(scope="module")
def recording(begun, shapes):
    return record(begun, shapes, 1)


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
    at = first * SUBSTEPS + substep
    pieces = batch(replace(recording, starts=np.array([[e, first]]), is_busy=np.array([True])), table, np.array([0]))
    centre, quaternion = recording.centre[[e], at], recording.quaternion[[e], at]
    before = max(at - 1, 0)
    angular = turn_between(recording.quaternion[[e], before], quaternion)
    motion = sleeping(pieces.motion._replace(
        centre=centre, quaternion=quaternion, linear=centre - recording.centre[[e], before], angular=angular,
        pusher=recording.pusher[[e], at]))  # fmt: skip
    shift = recording.pusher[[e], at + 1] - motion.pusher
    heading = headings(recording.velocity[[e], first], motion)
    return len(build_graph(table, pieces.number, motion, Sweep(heading, shift)).scene) > 0


def beside(recorded) -> Disturbed:
    """Rows that repeat what was recorded itself."""
    poses = substates(recorded)
    step = np.arange(1, len(poses.position) - 1)
    turned = quaternion_multiply(poses.quaternion[step], quaternion_conjugate(poses.quaternion[step - 1]))
    angular = quaternion_log(turned)
    linear = np.diff(poses.position, axis=0)[step - 1]
    parts = (poses.position[step], poses.quaternion[step], linear, angular,
             poses.position[step + 1], poses.quaternion[step + 1])  # fmt: skip
    return Disturbed(step, *(part.astype(np.float32) for part in parts))


def test_disturbed_states_become_graphs_like_recorded_ones(begun, shapes, table):
    """Rows that repeat the recording teach what it teaches."""
    recorded = begun[0]
    plain = samples(record([recorded], shapes, 1), table)
    rows = list(disturbed_substeps([replace(recorded, disturbed=beside(recorded)), recorded], shapes))
    both = samples(record([recorded], shapes, 1), table, others=rows)
    assert len(rows) == 1
    assert len(plain) < len(both) <= 2 * len(plain)
    old = plain.draw(torch.arange(len(plain)), torch.zeros(len(plain), dtype=torch.bool))
    kept = both.draw(torch.arange(len(plain)), torch.zeros(len(plain), dtype=torch.bool))
    assert torch.equal(old.nodes, kept.nodes)
    extra = len(both) - len(plain)
    new = both.draw(torch.arange(len(plain), len(both)), torch.zeros(extra, dtype=torch.bool))
    last = plain.draw(torch.arange(len(plain) - extra, len(plain)), torch.zeros(extra, dtype=torch.bool))
    assert new.nodes.shape == last.nodes.shape
    off = (new.target - last.target).abs()
    assert off.median() < 0.01
    assert off.mean() < 0.05


def test_episodes_without_disturbed_states_add_nothing(begun, shapes):
    assert list(disturbed_substeps(begun, shapes)) == []


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
