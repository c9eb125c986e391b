from dataclasses import replace

import numpy as np
import pytest
import torch

from osfcore.errors import InvalidInput
from osfcore.paper.train_dynamics import record, windows
from tests.core.paper.dynamics.scenes import BOX, CAN, KAPPAS, episode, network


def test_windows_are_pieces_of_their_episodes():
    episodes = [episode(0), episode(1, names=(BOX, CAN))]
    recording = record(episodes, network(), KAPPAS, 3)
    assert recording.starts.tolist() == [[e, at] for e in (0, 1) for at in range(6)]
    found = windows(recording, np.array([2, 11]))
    for row, (e, at) in enumerate(((episodes[0], 2), (episodes[1], 5))):
        np.testing.assert_allclose(found.start.position[row], e.positions[at], atol=1e-7)
        np.testing.assert_allclose(found.position[row], e.positions[at + 1 : at + 4], atol=1e-7)
        np.testing.assert_allclose(found.quaternion[row], e.quaternions[at + 1 : at + 4], atol=1e-7)
        np.testing.assert_allclose(found.pusher[row], e.pusher[at : at + 4], atol=1e-7)
        np.testing.assert_allclose(found.start.pusher[row], e.pusher[at], atol=1e-7)
        np.testing.assert_allclose(found.action[row], e.actions[at : at + 3], atol=1e-7)
        assert found.number[row].tolist() == [network().number(name) for name in e.names]
        torch.testing.assert_close(found.kappa[row], torch.tensor([KAPPAS[name] for name in e.names]))


def test_windows_in_which_something_falls_off_the_table_are_left_out():
    whole = episode(0)
    positions = whole.positions.copy()
    positions[6:, 0, 2] = -0.5
    recording = record([replace(whole, positions=positions)], network(), KAPPAS, 3)
    assert recording.starts.tolist() == [[0, 0], [0, 1], [0, 2]]
    positions[:, 0, 2] = -0.5
    with pytest.raises(InvalidInput, match="stay on the table is 0"):
        record([replace(whole, positions=positions)], network(), KAPPAS, 3)


@pytest.mark.parametrize(
    "episodes", [[episode(0), episode(1, steps=9)], [episode(0), episode(1, names=(CAN,))], [episode(0, steps=2)]]
)
def test_episodes_that_do_not_go_together_are_told(episodes):
    with pytest.raises(InvalidInput, match="steps and objects of the episodes"):
        record(episodes, network(), KAPPAS, 3)
