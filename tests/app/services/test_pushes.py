"""Pushes by hand: how far they go, what is predicted of them, and what came of it."""

from concurrent.futures import Future
from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from app.processes.client import ProcessUnavailable
from app.processes.messages.neural_messages import Predicted
from app.processes.messages.scene_messages import SceneChanged, SceneRecord
from app.services.event_hub import CurrentScene, Hub
from app.services.fields import MissingFields
from app.services.pushes import (
    SPEED_M_S,
    CannotExecute,
    NothingToPush,
    PushChanged,
    Pushes,
    beyond_nearest,
    outcomes,
    toward,
)
from app.services.scenes import SceneHeld
from osfcore.errors import InvalidInput
from osfcore.geometry.light import Light
from osfcore.geometry.poses import Pose
from osfcore.geometry.rollouts import Rollouts, check_actions
from osfcore.geometry.states import SceneState
from osfcore.geometry.workspace import PUSHER_CENTRE_Z_M, PUSHER_REACH_M, STEP_S

BOX, CAN = "003_cracker_box", "005_tomato_soup_can"
place = st.floats(-0.5, 0.5)


def state(positions, quaternions=None, pusher=(0.1, 0.2)):
    count = len(positions)
    turns = np.tile([1.0, 0, 0, 0], (count, 1)) if quaternions is None else np.array(quaternions)
    hand = None if pusher is None else np.array([*pusher, PUSHER_CENTRE_Z_M])
    poses = Pose(np.array(positions, float).reshape(count, 3), turns.reshape(count, 4))
    return SceneState((BOX, CAN)[:count], poses, Light(np.array([0, 0, 1.0])), hand)


@given(st.tuples(place, place), st.floats(0.05, 0.3))
def test_a_push_ends_at_its_target_within_limits(target, speed):
    start = np.array([0.3, 0.3])
    try:
        actions = toward(start, np.array(target), speed)
    except InvalidInput:
        return
    check_actions(actions[None])
    assert np.linalg.norm(actions, axis=1).max() <= speed + 1e-9
    end = start + STEP_S * actions[:, :2].sum(axis=0)
    np.testing.assert_allclose(end, np.clip(target, -PUSHER_REACH_M, PUSHER_REACH_M), atol=1e-9)


def test_a_fast_diagonal_keeps_to_the_limit_of_each_axis():
    actions = toward(np.zeros(2), np.array([0.12, 0.0]), 1.0)
    np.testing.assert_allclose(actions, [[0.3, 0, 0], [0.3, 0, 0]], atol=1e-12)


@pytest.mark.parametrize(
    ("target", "speed", "words"), [([0.0, 0.0], 0.1, "is 0"), ([0.3, 0.3], 0.01, "50"), ([np.nan, 0], 0.1, "finite")]
)
def test_pushes_that_lead_nowhere_or_take_too_long_are_refused(target, speed, words):
    with pytest.raises(InvalidInput, match=words):
        toward(np.zeros(2), np.array(target), speed)


def test_the_nearest_object_is_pushed_a_little_beyond_its_place():
    target = beyond_nearest(state([[0.1, 0.1, 0.1], [-0.2, 0.2, 0.1]]))
    assert target == pytest.approx([0.1, 0.05])
    assert beyond_nearest(state([])) is beyond_nearest(state([[0, 0, 0]], pusher=None)) is None


def test_outcomes_tell_ways_and_errors(library):
    before = state([[0, 0, 0.1], [0.2, 0, 0.05]])
    turned = np.array([np.cos(0.1), 0, 0, np.sin(0.1)])
    after = state([[0.05, 0, 0.1], [0.2, 0, 0.05]], [turned, [1, 0, 0, 0]])
    end = np.array([[0.04, 0, 0.1], [0.2, 0, 0.05]])
    rollouts = Rollouts(
        before.names,
        np.stack([before.poses.position, end])[None],
        np.stack([before.poses.quaternion] * 2)[None],
        np.zeros((1, 2, 3)),
    )
    box, can = outcomes(before, rollouts, None, library)
    assert (box.predicted_mm, box.went_mm, box.off_deg) == (pytest.approx(40), None, None)
    box, can = outcomes(before, rollouts, after, library)
    assert (box.went_mm, box.off_mm) == (pytest.approx(50), pytest.approx(10))
    assert (box.predicted_deg, box.turned_deg, box.off_deg) == pytest.approx((0, np.rad2deg(0.2), np.rad2deg(0.2)))
    assert (can.predicted_mm, can.went_mm, can.off_mm) == (0, 0, 0)


# The push that is tried

START = state([[0, 0, 0.1], [0.2, 0.1, 0.05]], pusher=(-0.1, 0))
RECORD = SceneRecord("s", 7, "2026-01-01T00:00:00.000Z", 128, START, START, 0.0, 3)


class Table:
    """A table and a predictor made of air; the simulator moves the box by 5 cm, whatever the push.

    Attributes:
        asked: orders that were sent, and where their answers go.
        refusal: of the next order or action.
        jumps_in: whether somebody else acts at the same time.
    """

    def __init__(self):
        self.hub, self.record, self.is_warm = Hub(), RECORD, True
        self.asked, self.acted, self.published, self.refusal, self.jumps_in = [], [], [], None, False
        self.pushes = Pushes(self, self, self.hub)
        self.hub.subscribe(lambda event: self.published.append(event) if isinstance(event, PushChanged) else None)

    def current(self):
        return self.record

    def submit(self, of, actions, key):
        if self.refusal:
            raise self.refusal
        self.asked.append((of, actions, key, Future()))
        return self.asked[-1][-1]

    def act(self, scene, actions):
        if self.refusal:
            raise self.refusal
        self.acted.append((scene, np.array(actions)))
        if self.jumps_in:
            self.change()
        for number in range(1, len(actions) + 1):
            self.change(0.05 * number / len(actions))

    def change(self, x=0.0):
        now = state([[x, 0, 0.1], [0.2, 0.1, 0.05]], pusher=(-0.1, 0))
        self.record = replace(self.record, state=now, revision=self.record.revision + 1)
        self.hub.publish(SceneChanged(self.record, (now,), 0.1))

    def answer(self, number=-1, goes_m=0.04):
        of, actions, _, answer = self.asked[number]
        count = actions.shape[1] + 1
        positions = np.tile(of.poses.position, (1, count, 1, 1))
        positions[0, :, 0, 0] = np.linspace(0, goes_m, count)
        quaternions = np.tile([1.0, 0, 0, 0], (1, count, 2, 1))
        answer.set_result(Predicted(Rollouts(of.names, positions, quaternions, np.zeros((1, count, 3))), 0.02))

    def predict(self):
        self.pushes.predict()
        self.answer()


@pytest.fixture
def table():
    return Table()


def states(table):
    return [event.push and event.push.state for event in table.published]


def test_from_a_choice_to_the_error(table, library):
    chosen = table.pushes.predict(np.array([-0.1, 0.15]))
    ((of, actions, _, _),) = table.asked
    assert of is RECORD.state
    np.testing.assert_allclose(actions, np.tile([0, SPEED_M_S, 0], (1, 3, 1)), atol=1e-9)
    np.testing.assert_allclose(chosen.way, [[-0.1, 0], [-0.1, 0.15]], atol=1e-9)
    assert chosen.outcomes(library) == ()
    table.answer()
    box, can = table.pushes.current.outcomes(library)
    assert (box.predicted_mm, box.went_mm) == (pytest.approx(40), None)
    done = table.pushes.execute()
    ((scene, acted),) = table.acted
    assert scene == "s"
    np.testing.assert_array_equal(acted, actions[0])
    assert len(done.truth) == 1 + 2 * len(acted)  # the start, and on the way and after each action
    box, can = done.outcomes(library)
    assert (box.went_mm, box.off_mm, can.off_mm) == pytest.approx((50, 10, 0))
    assert states(table) == ["predicting", "predicted", "executing", "executing", "executing", "executed"]
    table.pushes.drop()
    assert table.pushes.current is None
    assert states(table)[-1] is None


def test_without_a_choice_the_nearest_object_is_pushed(table):
    table.pushes.predict(speed_m_s=0.25)
    np.testing.assert_allclose(table.asked[0][1], np.tile([0.25, 0, 0], (1, 3, 1)), atol=1e-9)  # 10 cm, and 5 more


@pytest.mark.parametrize("when", ["predicting", "predicted", "executed"])
def test_any_other_change_of_the_table_ends_it(table, when):
    table.pushes.predict()
    if when != "predicting":
        table.answer()
    if when == "executed":
        table.pushes.execute()
    table.change()
    push = table.pushes.current
    assert (push.state, push.rollouts, push.truth) == ("outdated", None, ())
    assert push.problem
    if when == "predicting":
        table.answer()  # too late
        assert table.pushes.current is push


def test_old_news_and_other_tables_do_not_matter(table):
    table.predict()
    before = table.pushes.current
    table.hub.publish(SceneChanged(RECORD, (), 0.1))
    table.hub.publish(SceneChanged(replace(RECORD, id="other", revision=99), (), 0.1))
    assert table.pushes.current is before
    table.hub.publish(CurrentScene(None))
    assert table.pushes.current is None


def test_what_somebody_else_does_at_the_same_time_is_not_taken_for_the_push(table):
    table.predict()
    table.jumps_in = True
    assert table.pushes.execute().state == "outdated"


def test_a_refused_prediction_leaves_nothing_behind(table):
    table.refusal = MissingFields(["my_thing"])
    with pytest.raises(MissingFields):
        table.pushes.predict()
    assert table.pushes.current is None


def test_a_refused_execution_can_be_tried_again(table):
    table.predict()
    table.refusal = SceneHeld("episode")
    with pytest.raises(SceneHeld):
        table.pushes.execute()
    table.refusal = None
    assert table.pushes.execute().state == "executed"


def test_an_answer_may_be_overtaken_or_a_refusal(table):
    table.pushes.predict()
    table.pushes.predict(np.array([0.1, 0.1]))
    assert len({key for _, _, key, _ in table.asked}) == 1  # so that the second overtakes the first
    table.asked[0][-1].set_result(None)
    assert table.pushes.current.state == "predicting"
    table.asked[1][-1].set_exception(ProcessUnavailable("predictor", "stopped unexpectedly"))
    assert table.pushes.current.state == "refused"
    assert "stopped unexpectedly" in table.pushes.current.problem


def test_a_defect_is_not_told_but_logged(table, caplog):
    table.pushes.predict()
    table.asked[0][-1].set_exception(ZeroDivisionError("secret"))
    assert table.pushes.current.state == "refused"
    assert "secret" not in table.pushes.current.problem
    assert "ZeroDivisionError" in caplog.text


def test_each_prediction_is_executed_once(table):
    with pytest.raises(CannotExecute):
        table.pushes.execute()
    table.predict()
    table.pushes.execute()
    with pytest.raises(CannotExecute):
        table.pushes.execute()
    assert len(table.acted) == 1


def test_an_empty_table_is_refused_in_words(table):
    table.record = replace(RECORD, state=state([]))
    with pytest.raises(NothingToPush, match="put an object"):
        table.pushes.predict()
