"""Distortion of a lens, from the board in one photograph."""

import numpy as np
import pytest

from osfcore.errors import InvalidInput
from osfcore.experiments.board_views import board_errors, board_photograph, random_camera
from osfcore.photo.board import Board, locate_board
from osfcore.photo.lens import Lens, locate_board_through_lens
from tests.support.errors import about

VGA = (640, 480)
K = np.array([[560.0, 0, 320], [0, 560, 240], [0, 0, 1]])


def near_view(radial, seed=4):
    rng = np.random.default_rng(seed)
    pose, _ = random_camera(rng, VGA, (0.4, 0.4), (45, 50))
    return board_photograph(rng, VGA, Board(), (pose, K), radial=radial)


@pytest.fixture(scope="module")
def plain():
    return near_view(0.0)


@pytest.mark.parametrize(("radial", "is_known"), [(-0.05, True), (0.1, False)])
def test_distortion_is_found_and_the_camera_with_it(radial, is_known):
    view = near_view(radial)
    found, lens = locate_board_through_lens(view.image, Board(), K if is_known else None)
    assert abs(lens.radial - radial) < min(0.03, 4 * lens.std)
    straight = locate_board(view.image, Board(), K)
    distances = [np.linalg.norm(v.T_world_camera.position - view.T_world_camera.position) for v in (found, straight)]
    assert distances[0] < (0.001 if is_known else 0.005)
    assert not is_known or distances[0] < distances[1]


def test_without_distortion_the_camera_is_the_same(plain):
    found, lens = locate_board_through_lens(plain.image, Board(), K)
    assert lens.radial == 0
    assert lens.straightened(plain.image) is plain.image
    same = locate_board(plain.image, Board(), K)
    np.testing.assert_array_equal(found.T_world_camera.matrix(), same.T_world_camera.matrix())


@pytest.mark.parametrize("radial", [-0.08, 0.12])
def test_straightening_moves_what_is_bent_back(radial):
    lens, straight = Lens(K, radial), np.array([[100.5, 60.5], [320.5, 240.5], [500.5, 400.5]])
    image = np.zeros((480, 640), np.float32)
    rows, columns = np.mgrid[:480, :640] + 0.5
    for x, y in lens.bent(straight):
        image += np.exp(-((columns - x) ** 2 + (rows - y) ** 2) / 18).astype(np.float32)
    flat = lens.straightened(image)
    for x, y in straight:
        near = flat * ((columns - x) ** 2 + (rows - y) ** 2 < 15**2)
        centre = np.array([(near * columns).sum(), (near * rows).sum()]) / near.sum()
        assert np.linalg.norm(centre - (x, y)) < 0.2


def test_a_focal_length_that_the_board_contradicts_is_refused_and_one_a_little_off_is_no_distortion(plain):
    for factor in (0.5, 1.3):
        with pytest.raises(InvalidInput, check=about("focal length of the photo")):
            locate_board_through_lens(plain.image, Board(), K * [[factor], [factor], [1]])
    assert locate_board_through_lens(plain.image, Board(), K * [[1.04], [1.04], [1]])[1].radial == 0


@pytest.mark.slow
@pytest.mark.parametrize("radial", [-0.05, 0.1])
def test_cameras_behind_lenses_are_found_several_times_better(radial):
    bent, plain = (board_errors(8, np.random.default_rng(5), VGA, radial=k) for k in (radial, 0.0))
    assert np.isfinite(bent.rotation_rad).mean() > 0.9
    assert np.rad2deg(np.nanmedian(bent.rotation_rad)) < 0.03
    assert np.nanmedian(bent.nearby_m) < 0.001
    assert np.rad2deg(np.nanpercentile(plain.rotation_rad, 95)) < 0.04
