from dataclasses import FrozenInstanceError, fields, is_dataclass
from typing import get_args

import pytest

from osfcore.control.events import Event, Noticed


def test_events_are_frozen_and_number_the_actions_executed():
    for kind in get_args(Event):
        assert is_dataclass(kind)
        assert kind.__dataclass_params__.frozen
        assert fields(kind)[0].name == "number" or kind.__name__ == "GoalFound"


def test_what_was_noticed_stays_as_it_was_told():
    notice = Noticed(3, "lamp", "The lamp was moved.")
    assert notice.names == ()
    with pytest.raises(FrozenInstanceError):
        notice.number = 4
