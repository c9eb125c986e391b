import numpy as np
import pytest

from osfcore.geometry.light import Light
from osfcore.geometry.poses import Pose
from osfcore.geometry.rollouts import Rollouts
from osfcore.geometry.states import SceneState
from osfcore.geometry.workspace import PUSHER_RADIUS_M, STEP_S
from osfcore.planning.pushes import push_outcomes, silhouette

CENTRE = np.array([0.0, 0.0, 0.01])
UPRIGHT = np.array([1.0, 0, 0, 0])
STATE = SceneState(
    ("box",),
    Pose(np.array([[0.1, -0.05, 0.02]]), UPRIGHT[None]),
    Light(np.array([0.0, 0.0, 1.0])),
    np.array([0.3, 0.3, 0.06]),
)
ORIGIN = STATE.poses.position[0, :2]


def rectangle(half_length: float, half_width: float, place=(0.0, 0.0)):
    return np.array([[1, 1], [-1, 1], [-1, -1], [1, -1]]) * [half_length, half_width] + place


def area(outline) -> float:
    x, y = outline.T
    return float(np.sum(x * np.roll(y, -1) - y * np.roll(x, -1))) / 2


def carried(state, actions, before=None, pushers=None) -> Rollouts:
    """A world in which the object goes along with the pusher, wherever that is."""
    path = np.pad(STEP_S * np.cumsum(actions, axis=1), ((0, 0), (1, 0), (0, 0)))
    positions = state.poses.position + path[:, :, None]
    quaternions = np.broadcast_to(state.poses.quaternion, (*positions.shape[:3], 4))
    return Rollouts(state.names, positions, quaternions, np.pad(pushers, ((0, 0), (0, 1)))[:, None] + path)


def table(predict=carried, halves=(0.05, 0.02)):
    return push_outcomes(predict, STATE, CENTRE, [rectangle(*halves, ORIGIN)])


def test_a_silhouette_runs_counterclockwise_around_all_parts():
    outline = silhouette([rectangle(0.05, 0.01), rectangle(0.01, 0.05)])
    assert area(outline) == pytest.approx(2 * 0.1 * 0.02 - 0.02**2, rel=0.1)
    assert np.abs(outline).max() == pytest.approx(0.05, abs=0.002)


@pytest.mark.parametrize("gap", [0.004, 0.05])
def test_parts_that_lie_apart_are_all_within_the_silhouette_and_the_loop(gap):
    """A small part beside a large one, with room for the pusher between them or not."""
    parts = [rectangle(0.05, 0.02), rectangle(0.01, 0.01, (0.06 + gap, 0.0))]
    outline = silhouette(parts)
    np.testing.assert_allclose(outline.max(axis=0), [0.07 + gap, 0.02], atol=0.002)
    assert area(outline) > 0.1 * 0.04 + 0.02 * 0.02
    outcomes = push_outcomes(carried, STATE, CENTRE, [part + ORIGIN for part in parts])
    for part in parts:
        low, high = part.min(axis=0), part.max(axis=0)
        away = np.maximum(np.maximum(low - outcomes.starts, outcomes.starts - high), 0)
        assert np.linalg.norm(away, axis=1).min() > PUSHER_RADIUS_M
        away = np.maximum(np.maximum(low - outcomes.loop, outcomes.loop - high), 0)
        assert np.linalg.norm(away, axis=1).min() > PUSHER_RADIUS_M


def test_pushes_begin_clear_of_the_object_on_all_sides_and_lead_into_it():
    outcomes = table()
    outside = np.linalg.norm(np.maximum(np.abs(outcomes.starts) - [0.05, 0.02], 0), axis=1)
    assert outside.min() > PUSHER_RADIUS_M
    np.testing.assert_allclose(np.linalg.norm(outcomes.directions, axis=1), 1, atol=1e-12)
    sides = [outcomes.starts[:, axis] * sign > half for axis, half in ((0, 0.05), (1, 0.02)) for sign in (-1, 1)]
    assert all(side.sum() >= 10 for side in sides)
    path = outcomes.starts[:, None] + outcomes.lengths[:, None] * outcomes.directions[:, None]
    nearest = np.linalg.norm(np.maximum(np.abs(path) - [0.05, 0.02], 0), axis=2).min(axis=1)
    assert (nearest < PUSHER_RADIUS_M).all()


def test_motions_are_told_around_the_centre_of_mass_for_every_length():
    outcomes = table()
    assert (np.diff(outcomes.lengths) > 0).all()
    np.testing.assert_allclose(outcomes.centres, outcomes.lengths[:, None] * outcomes.directions[:, None], atol=1e-12)
    np.testing.assert_allclose(outcomes.quaternions, np.broadcast_to(UPRIGHT, outcomes.quaternions.shape), atol=1e-12)


def test_every_push_is_predicted_from_its_own_place():
    seen = []

    def recorded(state, actions, before=None, pushers=None):
        seen.append(pushers)
        return carried(state, actions, before, pushers)

    outcomes = table(recorded)
    np.testing.assert_allclose(seen[0], outcomes.starts + ORIGIN, atol=1e-12)


def test_without_a_predictor_there_are_no_pushes_but_a_loop_around_the_object():
    outcomes = table(None)
    assert len(outcomes.starts) == len(outcomes.centres) == 0
    outside = np.linalg.norm(np.maximum(np.abs(outcomes.loop) - [0.05, 0.02], 0), axis=1)
    assert outside.min() > PUSHER_RADIUS_M
    assert outside.max() < PUSHER_RADIUS_M + 0.02
    assert area(outcomes.loop) > 0
