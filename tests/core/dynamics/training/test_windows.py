from dataclasses import replace

import numpy as np
import pytest
import torch

from osfcore.dynamics.graph import unroll
from osfcore.dynamics.motion import SUBSTEPS
from osfcore.dynamics.rollout import load_shapes
from osfcore.dynamics.shapes import ShapeTable
from osfcore.dynamics.train import batch, record
from osfcore.errors import InvalidInput
from osfcore.fields.field_library import FieldLibrary
from osfcore.geometry.poses import rotate
from osfcore.io.push_file import read_pushes
from osfcore.world.collect_pushes import CollectPushes, collect_pushes
from tests.core.dynamics.scenes import BOX, CAN, GELATIN, crowd, episode, network, picked, scene

PUSH = [[0.3, 0.0, 0], [0.2, 0.05, 0], [0.1, -0.1, 0], [-0.3, 0, 0], [-0.3, 0, 0], [0, 0, 0]]


@pytest.fixture(scope="module")
def pushed(shapes):
    return episode(shapes, crowd(shapes), PUSH)


def test_a_recording_tells_what_the_episode_tells(shapes, pushed):
    recording = record([pushed, pushed], shapes, 2)
    assert recording.centre.shape == (2, 6 * SUBSTEPS + 1, 4, 3)
    assert recording.pusher.shape == (2, 6 * SUBSTEPS + 1, 2)
    names = sorted(shapes)
    assert [names[n] for n in recording.number[0]] == list(pushed.names)
    centres = pushed.positions + rotate(pushed.quaternions, np.array([shapes[n].centre for n in pushed.names]))
    np.testing.assert_allclose(recording.centre[1, ::SUBSTEPS], centres, atol=1e-6)
    np.testing.assert_allclose(recording.quaternion[1, ::SUBSTEPS], pushed.quaternions, atol=1e-6)
    np.testing.assert_allclose(recording.pusher[1, ::SUBSTEPS], pushed.pusher[:, :2], atol=1e-6)
    np.testing.assert_allclose(recording.velocity[0], np.array(PUSH)[:, :2], atol=1e-6)
    assert recording.length == 2


@pytest.mark.parametrize("length", [1, 3, 6])
def test_windows_begin_wherever_they_fit(shapes, pushed, length):
    recording = record([pushed, pushed], shapes, length)
    expected = [(e, t) for e in range(2) for t in range(6 - length + 1)]
    assert [tuple(start) for start in recording.starts] == expected
    busy = [any(pushed.contact[t : t + length].any() for t in [start]) for _, start in expected]
    assert all(recording.is_busy[np.array(busy)])
    if length == 1:
        assert not recording.is_busy[-1]  # the pusher has left and everything rests


def test_what_comes_near_the_edge_is_not_learned_from(shapes, pushed):
    positions = pushed.positions.copy()
    positions[3, 0, 0] = 0.57
    starts = record([replace(pushed, positions=positions)], shapes, 2).starts[:, 1]
    np.testing.assert_array_equal(starts, [0, 4])
    positions = pushed.positions.copy()
    positions[6, 1, 2] = -0.7
    np.testing.assert_array_equal(record([replace(pushed, positions=positions)], shapes, 2).starts[:, 1], range(4))
    positions[:, 1, 2] = -0.7
    assert record([replace(pushed, positions=positions)], shapes, 2).starts.shape == (0, 2)


def test_a_window_rolled_out_with_what_made_it_meets_its_targets(shapes, table, pushed):
    """States and velocities at the start of a window are all there is to know."""
    recording = record([pushed], shapes, 2)
    pieces = batch(recording, table, np.arange(len(recording.starts)))
    assert pieces.targets.centre.shape == (2 * SUBSTEPS, 5, 4, 3)
    net = network(silent=True)
    with torch.inference_mode():
        motions = list(unroll(net, table, pieces.number, pieces.motion, pieces.velocity))
    for step, motion in enumerate(motions):
        error = (motion.centre - pieces.targets.centre[step]).norm(dim=-1)
        assert error.max() < 1e-3
        assert error.median() < 1e-5


def test_velocities_are_those_of_the_last_substep(shapes, table, pushed):
    recording = record([pushed], shapes, 1)
    pieces = batch(recording, table, np.arange(6))
    moved = recording.centre[0, SUBSTEPS] - recording.centre[0, SUBSTEPS - 1]
    torch.testing.assert_close(pieces.motion.linear[1, 0], moved[0])
    assert not pieces.motion.linear[0].any()  # the beginning of an episode is at rest
    assert not pieces.motion.linear[:, pushed.names.index(BOX)].any()
    assert pieces.motion.angular.shape == (6, 4, 3)
    assert pieces.motion.floor.max() <= 0
    np.testing.assert_allclose(pieces.velocity[0], np.array(PUSH)[:, :2], atol=1e-6)


def test_coarse_velocities_are_means_over_the_action_before(shapes, table, pushed):
    found = record([pushed], shapes, 1)
    windows = np.arange(len(found.starts))
    coarse = batch(found, table, windows, coarse=np.ones(len(windows), bool)).motion
    fine = batch(found, table, windows).motion
    for number, (_, start) in enumerate(found.starts):
        first = start * SUBSTEPS
        mean = (found.centre[0, first] - found.centre[0, max(first - SUBSTEPS, 0)]) / SUBSTEPS
        moves = coarse.linear[number].norm(dim=1) > 0
        torch.testing.assert_close(coarse.linear[number][moves], mean[moves], atol=1e-7, rtol=1e-5)
    assert torch.equal(coarse.linear[0], torch.zeros_like(coarse.linear[0]))
    assert not torch.equal(coarse.linear, fine.linear)
    assert torch.equal(coarse.centre, fine.centre)


def test_episodes_with_other_objects_go_together(shapes, table):
    one = episode(shapes, scene(shapes, {CAN: (0.06, 0.0), BOX: (-0.2, 0.0)}), PUSH)
    other = episode(shapes, scene(shapes, {GELATIN: (0.07, 0.0), CAN: (0.2, 0.1)}), PUSH)
    recording = record([one, other], shapes, 1)
    names = sorted(shapes)
    assert [[names[n] for n in row] for row in recording.number] == [[CAN, BOX], [GELATIN, CAN]]
    last = batch(recording, table, np.array([len(recording.starts) - 1]))
    assert [names[n] for n in last.number[0]] == [GELATIN, CAN]


@pytest.mark.parametrize("change", ["without", "fewer"])
def test_recordings_without_the_right_substeps_are_refused(shapes, pushed, change):
    if change == "without":
        wrong = replace(pushed, sub_positions=None, sub_quaternions=None)
    else:
        wrong = replace(
            pushed, sub_positions=pushed.sub_positions[:, 1:], sub_quaternions=pushed.sub_quaternions[:, 1:]
        )
    with pytest.raises(InvalidInput, match="collect pushes"):
        record([wrong], shapes, 1)


def test_episodes_that_do_not_fit_together_are_refused(shapes, pushed):
    short = episode(shapes, crowd(shapes), PUSH[:3])
    few = episode(shapes, picked(crowd(shapes), [0, 1]), PUSH)
    for episodes, length in (([pushed, short], 1), ([pushed, few], 1), ([short], 4), ([], 1)):
        with pytest.raises(InvalidInput, match="steps and objects of the episodes"):
            record(episodes, shapes, length)


def test_real_collections_can_be_learned_from(library, tmp_path):
    config = CollectPushes(tmp_path / "a.h5", episodes=2, steps=8, policy="directed")
    list(collect_pushes(config, library))
    episodes = read_pushes(config.out)
    shapes = load_shapes(None, FieldLibrary(None), {name for e in episodes for name in e.names})
    recording = record(episodes, shapes, 3)
    assert len(recording.starts) == 12
    assert recording.is_busy.any()
    for number, e in enumerate(episodes):
        told = recording.pusher[number, ::SUBSTEPS].numpy()
        np.testing.assert_allclose(told, e.pusher[:, :2], atol=1e-5)
    table = ShapeTable(tuple(shapes[name] for name in sorted(shapes)))
    pieces = batch(recording, table, np.arange(12))
    assert pieces.motion.floor.min() > -0.004  # fields and collision shapes agree on where the table is
    step = (pieces.targets.centre[0] - pieces.motion.centre).norm(dim=-1)
    assert step.max() < 0.05  # nothing jumps
