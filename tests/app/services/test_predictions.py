"""Asking for predictions, with a process that is made of air."""

from concurrent.futures import Future
from types import SimpleNamespace

import numpy as np
import pytest

from app.services.fields import MissingFields
from app.services.pushes import NothingToPush, Predictions
from osfcore.errors import InvalidInput
from osfcore.geometry.poses import Pose
from osfcore.geometry.states import SceneState
from tests.app.storage.test_database import record
from tests.support.errors import about

RECORD = record()
STATE = SceneState(RECORD.state.names, RECORD.state.poses, RECORD.state.light, np.array([0.0, 0.2, 0.06]))
ACTIONS = np.zeros((1, 2, 3))


class Link:
    is_warm = True

    def __init__(self):
        self.orders = []

    def submit(self, order):
        self.orders.append(order)
        return Future()


def asking(link, current="s", fields=STATE.names):
    return Predictions(SimpleNamespace(current=current, get=lambda _: RECORD), lambda: fields, link)


def test_orders_are_passed_on_with_a_key():
    link = Link()
    predictions = asking(link)
    assert predictions.is_warm
    for key in ("a", None, None):
        assert not predictions.submit(STATE, ACTIONS.tolist(), key).done()
    assert link.orders[0].key == "a"
    assert len({order.key for order in link.orders}) == 3
    np.testing.assert_array_equal(link.orders[0].actions, ACTIONS)


def test_the_scene_on_the_table():
    assert asking(Link()).current() is RECORD
    with pytest.raises(NothingToPush):
        asking(Link(), current=None).current()


def test_what_cannot_be_predicted_is_refused_at_once():
    link = Link()
    predictions = asking(link)
    with pytest.raises(InvalidInput, check=about("pusher")):
        predictions.submit(SceneState(STATE.names, STATE.poses, STATE.light, None), ACTIONS)
    nothing = SceneState((), Pose(np.zeros((0, 3)), np.zeros((0, 4))), STATE.light, STATE.pusher)
    with pytest.raises(InvalidInput, check=about("number of objects")):
        predictions.submit(nothing, ACTIONS)
    with pytest.raises(InvalidInput, check=about("horizon")):
        predictions.submit(STATE, np.zeros((1, 10_000, 3)))
    with pytest.raises(MissingFields, check=about(STATE.names[0])):
        asking(link, fields=()).submit(STATE, ACTIONS)
    assert link.orders == []
