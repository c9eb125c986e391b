from dataclasses import replace

import numpy as np

from app.services.pushes import Outcome
from app.viewer.panels.push_prediction import PushPrediction, report
from osfcore.geometry.rollouts import Rollouts
from tests.app.storage.test_database import record

NOTHING = Rollouts(("x", "y"), np.zeros((1, 3, 2, 3)), np.zeros((1, 3, 2, 4)), np.zeros((1, 3, 3)))


def trial():
    return PushPrediction(record(revision=5), np.zeros((2, 3)), NOTHING, 0.1)


def test_it_follows_its_own_execution_action_by_action():
    new = trial()
    first = new.after(record(revision=6), (record().state,), new)
    assert not first.is_executed
    assert len(first.truth) == 3  # the start, the way, the end
    done = first.after(record(revision=7), (), new)
    assert done.is_executed
    assert len(done.truth) == 4
    assert done.after(record(revision=7), (), None) is done
    assert done.after(record(revision=8), (), None) is None


def test_any_other_change_ends_it_and_old_news_do_not():
    new = trial()
    assert new.after(record(revision=5), (), None) is new
    assert new.after(record(revision=6), (), None) is None
    assert new.after(record(revision=6), (), replace(new, rollouts=replace(NOTHING))) is None
    assert new.after(record(revision=8), (), new) is None


def test_nothing_is_no_table():
    assert report((), {}) == ""


def test_before_and_after():
    before = report([Outcome("a", 12.34, 5.0)], {"a": "A box"})
    assert "A box" in before
    assert "12 mm<br>5.0°" in before
    assert "Off by" not in before
    after = report([Outcome("a", 12.34, 5.0, 9.96, 0.0, 2.4, 5.0), Outcome("b", 0, 0, 0, 0, 0, 0)], {})
    assert "<b>2.4 mm<br>5.0°</b>" in after
    assert "10 mm<br>0.0°" in after
    assert "still" in after


def test_what_users_name_is_escaped():
    assert "<script" not in report([Outcome("<script>", 1, 1)], {})
    assert "&lt;b&gt;" in report([Outcome("a", 1, 1)], {"a": "<b>"})
