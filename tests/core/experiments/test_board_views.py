import numpy as np
import pytest

from osfcore.experiments.board_views import board_errors

VGA = (640, 480)


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
