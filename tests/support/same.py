"""Comparison of values of any depth, such as what comes back from a file with what was written."""

from dataclasses import fields, is_dataclass

import numpy as np

from osfcore.geometry.poses import Pose


def assert_same(found, expected, atol=0.0):
    """Check that two values agree: arrays, poses and floats within a tolerance, everything else exactly."""
    if isinstance(expected, Pose):
        found, expected = found.matrix(), expected.matrix()
    if is_dataclass(expected):
        for field in fields(expected):
            assert_same(getattr(found, field.name), getattr(expected, field.name), atol)
    elif isinstance(expected, tuple | list):
        assert len(found) == len(expected)
        for one, other in zip(found, expected, strict=True):
            assert_same(one, other, atol)
    elif isinstance(expected, np.ndarray | float):
        np.testing.assert_allclose(found, expected, atol=atol, rtol=0)
    else:
        assert found == expected
