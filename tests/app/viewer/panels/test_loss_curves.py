import numpy as np

from app.viewer.panels.loss_curves import LossCurves
from osfcore.estimation.steps import EstimateStep
from osfcore.geometry.light import Light
from osfcore.geometry.poses import Pose
from osfcore.geometry.states import SceneState
from osfcore.progress import Progress

STATE = SceneState((), Pose(np.zeros((0, 3)), np.zeros((0, 4))), Light(np.array([0, 0, 1.0])), None)
NAN = float("nan")


def curves(*rows):
    result = LossCurves(("a", "b"))
    for stage, losses, loss in rows:
        result = result.with_step(EstimateStep(Progress(1, 9, ""), stage, STATE, losses=losses, loss=loss))
    return result


def test_each_curve_is_relative_to_its_largest_loss_of_the_stage_with_gaps_between_stages():
    numbers, a, b, whole = curves(
        ("objects", (0.8, 0.1), NAN), ("objects", (0.4, 0.2), NAN), ("together", (), 5e-5), ("together", (), 4e-5)
    ).drawn()
    np.testing.assert_allclose(numbers, [1, 2, 2.5, 3, 4, 4.5])
    np.testing.assert_allclose(a, [1, 0.5, NAN, NAN, NAN, NAN])
    np.testing.assert_allclose(b, [0.5, 1, NAN, NAN, NAN, NAN])
    np.testing.assert_allclose(whole, [NAN, NAN, NAN, 1, 0.8, NAN])


def test_objects_that_were_not_looked_at_yet_have_no_loss():
    _, a, b, _ = curves(("orientations", (0.3,), NAN), ("orientations", (0.3, 0.6), NAN)).drawn()
    np.testing.assert_allclose(a, [1, 1, NAN])
    np.testing.assert_allclose(b, [NAN, 1, NAN])


def test_a_stage_that_comes_again_counts_anew():
    _, a, _, _ = curves(
        ("orientations", (4.0, 1), NAN), ("light", (9.0, 1), NAN), ("orientations", (2.0, 1), NAN)
    ).drawn()
    np.testing.assert_allclose(a, [1, NAN, 1, NAN, 1, NAN])


def test_nothing_and_losses_of_zero_can_be_drawn():
    assert [len(column) for column in curves().drawn()] == [0, 0, 0, 0]
    _, a, _, whole = curves(("polish", (0.0, 1.0), 0.0)).drawn()
    assert (a[0], whole[0]) == (0, 0)
