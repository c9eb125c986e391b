from dataclasses import replace

import numpy as np
import pytest

from osfcore.control.world import Sight, blind_cameras, brightness_change
from osfcore.geometry.cameras import default_cameras
from osfcore.geometry.states import Observation

SIDE = 32


def scene(shadow=slice(4, 16), seed=0, lit=0.6, shadowed=0.15):
    """Four views of a lit table with a shadow and some texture."""
    rng = np.random.default_rng(seed)
    images = np.full((4, SIDE, SIDE, 3), lit, np.float32)
    images[:, shadow, 8:20] = shadowed
    images *= rng.uniform(0.97, 1.03, images.shape).astype(np.float32)
    return Observation(default_cameras(SIDE), images, ("mug",), None, np.zeros(3), 0.0)


def as_bright(observation, factor):
    return replace(observation, images=observation.images * np.float32(factor))


def covered(observation, view):
    images = observation.images.copy()
    images[view] = 0.01
    return replace(observation, images=images)


@pytest.mark.parametrize("factor", [0.2, 0.45, 0.8, 1.3])
def test_a_common_factor_is_found_and_taken_out(factor):
    before, sight = scene(), Sight()
    sight.take(before)
    assert brightness_change(before, as_bright(before, factor)) == pytest.approx(factor, rel=1e-3)
    seen, changes = sight.take(as_bright(before, factor))
    assert [change.matter for change in changes] == ["brightness"]
    np.testing.assert_allclose(seen.images, before.images, atol=1e-5)
    again, changes = sight.take(as_bright(before, factor))
    assert changes == ()
    np.testing.assert_allclose(again.images, before.images, atol=1e-5)
    back, changes = sight.take(before)
    assert len(changes) == 1
    np.testing.assert_allclose(back.images, before.images, atol=1e-5)


def test_what_is_no_common_factor_is_left_to_the_search_for_the_lamp():
    moved, lower, higher = scene(shadow=slice(18, 30)), scene(lit=0.4), scene(lit=0.75, shadow=slice(2, 10))
    for now in (scene(seed=1), moved, lower, higher):  # noise, and a lamp under which shadows keep their radiance
        assert brightness_change(scene(), now) is None
        sight = Sight()
        sight.take(scene())
        seen, changes = sight.take(now)
        assert changes == ()
        assert seen is now


def test_covered_cameras_are_left_out_until_they_see_again():
    sight, clear = Sight(), scene()
    sight.take(clear)
    seen, (change,) = sight.take(covered(clear, 1))
    assert change.matter == "camera"
    assert [camera.name for camera in seen.cameras] == ["0", "2", "3"]
    np.testing.assert_array_equal(seen.images, clear.images[[0, 2, 3]])
    assert sight.take(covered(clear, 1))[1] == ()
    back, (change,) = sight.take(clear)
    assert change.matter == "camera"
    assert len(back.cameras) == 4
    dark = covered(covered(clear, 0), 1)  # two are always left
    assert blind_cameras(dark) == {"0", "1"}
    assert blind_cameras(covered(dark, 2)) == frozenset()
