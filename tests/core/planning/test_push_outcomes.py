import numpy as np
import pytest

from osfcore.geometry.workspace import PUSHER_RADIUS_M
from osfcore.planning.push_outcomes import push_outcomes, silhouette


def disc(radius: float, count: int = 64):
    angles = 2 * np.pi * np.arange(count) / count
    return radius * np.stack([np.cos(angles), np.sin(angles)], axis=1)


def rectangle(half_length: float, half_width: float):
    return np.array([[1, 1], [-1, 1], [-1, -1], [1, -1]]) * [half_length, half_width]


def area(outline) -> float:
    x, y = outline.T
    return float(np.sum(x * np.roll(y, -1) - y * np.roll(x, -1))) / 2


def cross(a, b):
    return a[..., 0] * b[..., 1] - a[..., 1] * b[..., 0]


def test_a_silhouette_runs_counterclockwise_around_all_parts():
    outline = silhouette([rectangle(0.05, 0.01), rectangle(0.01, 0.05)])
    assert area(outline) == pytest.approx(2 * 0.1 * 0.02 - 0.02**2, rel=0.08)
    assert np.abs(outline).max() == pytest.approx(0.05, abs=0.0015)


def test_pushes_begin_clear_of_the_object():
    outcomes = push_outcomes([rectangle(0.05, 0.02)])
    outside = np.maximum(np.abs(outcomes.starts) - [0.05, 0.02], 0)
    assert np.linalg.norm(outside, axis=1).min() > PUSHER_RADIUS_M
    np.testing.assert_allclose(np.linalg.norm(outcomes.directions, axis=1), 1)


def test_a_disc_pushed_through_its_middle_moves_straight_and_does_not_turn():
    outcomes = push_outcomes([disc(0.04)])
    aim = np.abs(cross(outcomes.starts, outcomes.directions))
    middle = aim < 5e-4
    assert middle.any()
    motion = outcomes.motions[middle, 3]
    gap = np.linalg.norm(outcomes.starts[middle], axis=1) - 0.04 - PUSHER_RADIUS_M
    along = (motion[:, :2] * outcomes.directions[middle]).sum(axis=1)
    np.testing.assert_allclose(along, outcomes.lengths[3] - gap, atol=1.5e-3)
    assert np.abs(motion[:, 2]).max() < 0.03


def test_a_push_beside_the_middle_turns_a_box_that_way():
    outcomes = push_outcomes([rectangle(0.06, 0.02)])
    moment = cross(outcomes.starts, outcomes.directions)  # about the centre, positive counterclockwise
    turn = outcomes.motions[:, 4, 2]
    clear = np.abs(moment) > 0.02
    assert clear.sum() > 50
    assert np.mean(np.sign(turn[clear]) == np.sign(moment[clear])) > 0.95


def test_longer_pushes_only_add_to_what_shorter_ones_did():
    """Nothing moves before it is touched, and the pusher never enters the object."""
    outcomes = push_outcomes([disc(0.03)])
    place = outcomes.starts[:, None] + outcomes.lengths[:, None] * outcomes.directions[:, None]
    gap = np.linalg.norm(place - outcomes.motions[..., :2], axis=-1) - 0.03 - PUSHER_RADIUS_M
    assert gap.min() > -2.5e-3
    step = np.linalg.norm(np.diff(outcomes.motions[..., :2], axis=1), axis=-1)
    assert step.max() < 0.01


def test_a_mirrored_object_moves_in_the_mirror():
    corners = np.array([[0.05, 0.0], [0.0, 0.03], [-0.04, 0.0], [0.0, -0.02]])
    one, other = (push_outcomes([part]) for part in (corners, corners[::-1] * [1, -1]))
    mirror = np.array([1.0, -1.0])
    for k in range(0, len(one.starts), 17):
        far = np.linalg.norm(other.starts - one.starts[k] * mirror, axis=1)
        far += np.linalg.norm(other.directions - one.directions[k] * mirror, axis=1)
        if far.min() < 0.02:
            off = np.abs(one.motions[k, 8] * [1, -1, -1] - other.motions[far.argmin(), 8])
            assert (off < [0.008, 0.008, 0.2]).all()


def test_the_loop_leads_around_the_object():
    outcomes = push_outcomes([rectangle(0.05, 0.02)])
    outside = np.linalg.norm(np.maximum(np.abs(outcomes.loop) - [0.05, 0.02], 0), axis=1)
    assert outside.min() > PUSHER_RADIUS_M
    assert outside.max() < PUSHER_RADIUS_M + 0.02
    assert area(outcomes.loop) > 0
