import numpy as np
import pytest

from osfcore.experiments.board_views import board_errors, board_photograph, random_camera
from osfcore.photo.board import Board

VGA = (640, 480)


def test_cameras_are_drawn_within_their_ranges_and_look_at_the_print():
    rng = np.random.default_rng(0)
    for _ in range(50):
        pose, intrinsics = random_camera(rng, VGA, (0.5, 0.7), (40, 50))
        x, y, z = pose.position
        assert 0.42 < np.linalg.norm(pose.position) < 0.78
        assert 33 < np.rad2deg(np.arctan2(z, np.hypot(x, y))) < 58
        centre = intrinsics @ pose.inverse().apply(np.zeros(3))
        assert np.all(np.abs(centre[:2] / centre[2] - (320, 240)) < 150)


def test_black_and_white_squares_appear_where_the_camera_sees_them():
    rng, board = np.random.default_rng(1), Board()
    view = board_photograph(rng, VGA, board, random_camera(rng, VGA, (0.5, 0.5), (60, 60)))
    columns, rows = np.meshgrid(np.arange(board.columns), np.arange(board.rows))
    # The margin of a square, between its edge and the marker's: black in every second square, white in the others
    places = np.stack([columns - board.columns / 2 + 0.08, board.rows / 2 - rows - 0.5, 0 * rows], axis=-1)
    seen = view.T_world_camera.inverse().apply(places * board.square_m) @ view.intrinsics.T
    pixels = np.floor(seen[..., :2] / seen[..., 2:]).astype(int)
    values = view.image[pixels[..., 1], pixels[..., 0]].mean(axis=-1)
    is_black = (columns + rows) % 2 == 0
    assert values[is_black].max() < values[~is_black].min()


def test_an_unknown_focal_length_costs_distance_and_refused_views_have_no_errors():
    known, unknown = (board_errors(2, np.random.default_rng(5), (320, 240), is_focal_known=k) for k in (True, False))
    assert [bool(refusal) for refusal in known.refusals] == np.isnan(known.rotation_rad).tolist()
    assert np.nanmax(np.abs(known.focal_share)) == 0
    assert 0 < np.nanmax(np.abs(unknown.focal_share)) < 0.05
    assert np.nanmax(unknown.camera_m) > np.nanmax(known.camera_m)


@pytest.mark.slow
def test_19_of_20_cameras_of_unknown_focal_length_are_found_within_a_centimetre():
    errors = board_errors(40, np.random.default_rng(3), VGA, is_focal_known=False)
    assert np.isfinite(errors.camera_m).mean() > 0.85
    assert np.nanpercentile(errors.camera_m, 95) < 0.01
