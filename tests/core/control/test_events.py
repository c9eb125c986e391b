import pytest

from osfcore.control.events import EpisodeSettings
from osfcore.errors import InvalidInput


@pytest.mark.parametrize(
    ("wrong", "told"),
    [
        ({"steps": 0}, "number of steps"),
        ({"steps": 10**6}, "number of steps"),
        ({"replan_every": 0}, "actions of each plan"),
        ({"cost": "depth"}, '"pose" or "image"'),
        ({"reached_m": -0.1}, "arrived"),
        ({"reached_rad": float("nan")}, "arrived"),
    ],
)
def test_what_is_out_of_range_is_named(wrong, told):
    with pytest.raises(InvalidInput, match=told):
        EpisodeSettings(**wrong)


def test_the_papers_thirty_steps_are_the_default():
    assert (EpisodeSettings().steps, EpisodeSettings().replan_every) == (100, 1)
