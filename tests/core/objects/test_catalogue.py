import numpy as np

from osfcore.geometry.poses import quaternion_multiply, rotation_angle
from osfcore.objects.catalogue import CATALOGUE


def test_discrete_symmetries_form_a_group():
    for info in CATALOGUE.values():
        group = np.array([(1.0, 0, 0, 0), *info.symmetry.rotations])
        products = quaternion_multiply(group[:, None], group[None]).reshape(-1, 4)
        nearest = rotation_angle(products[:, None], group[None]).min(axis=1)
        assert np.allclose(nearest, 0, atol=1e-6), info.name
        distinct = rotation_angle(group[:, None], group[None]) + np.eye(len(group))
        assert distinct.min() > 0.5, info.name
