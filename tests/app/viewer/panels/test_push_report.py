from app.services.pushes import Outcome
from app.viewer.panels.push_report import report


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
