import numpy as np
import pytest

from osfcore.errors import InvalidInput, UnknownName
from osfcore.estimation.objective import QUALITY, ObjectModels
from osfcore.geometry.poses import quaternion_exp
from osfcore.objects.asset import Symmetry
from osfcore.render.types import SceneBatch
from tests.core.render.scenes import ball, plain_table, state, view


def test_objects_without_a_field_are_refused(plain):
    plain.check(("ball", "block"))
    plain.check(())
    for ask in (lambda: plain.check(("ball", "mug")), lambda: plain.resting("mug")):
        with pytest.raises(UnknownName, match="no field named 'mug'; known: ball, block"):
            ask()


def test_resting_orientations_are_found_once(plain):
    assert plain.resting("ball") is plain.resting("ball")


def test_one_renderer_shows_the_table_and_the_other_black(plain):
    batch = SceneBatch.of(state({"ball": (0, 0, 0.05)}))
    alone = plain.alone.render(batch, [view()], quality=QUALITY, outputs={"rgb", "opacity"})
    together = plain.together.render(batch, [view()], quality=QUALITY, outputs={"rgb", "opacity"})
    np.testing.assert_array_equal(alone.opacity, together.opacity)
    empty = alone.opacity[0, 0, 0] == 0
    assert empty.any()
    assert not alone.rgb[0, 0][empty].any()
    assert together.rgb[0, 0][empty].min() > 0.02


def test_a_device_that_does_not_exist_is_refused():
    with pytest.raises(InvalidInput):
        ObjectModels({"ball": ball()}, plain_table(), device="abacus")


def test_orientations_that_look_the_same_are_not_turned():
    """About the axis of a body of revolution any angle is none, on the models themselves and on changed ones."""
    bowl = ObjectModels(
        {"ball": ball()}, plain_table(), symmetries={"ball": Symmetry("continuous", axis=(0.0, 0.0, 1.0))}
    )
    upright, about, tilted = np.eye(4)[0], np.eye(4)[3], quaternion_exp(np.array([0.5, 0.0, 0.0]))
    for models in (bowl, bowl.changed(("ball",), lambda field: field, lambda table: table)):
        np.testing.assert_allclose(
            models.turned("ball", upright, np.stack([upright, about, tilted])), [0, 0, 0.5], atol=1e-6
        )
    plain = ObjectModels({"ball": ball()}, plain_table())
    np.testing.assert_allclose(
        plain.turned("ball", upright, np.stack([upright, about, tilted])), [0, np.pi, 0.5], atol=1e-6
    )
