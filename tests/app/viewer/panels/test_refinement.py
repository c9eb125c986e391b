import pytest

from app.viewer.panels.refinement import REST_S, STEPS, Refinement


@pytest.fixture
def view():
    refinement = Refinement()
    refinement.moved(10.0)
    return refinement


def test_steps_grow_sharper():
    assert [step.is_sharp for step in STEPS] == [False, True, True]
    assert [step.rows for step in STEPS] == sorted(step.rows for step in STEPS)
    assert 96 <= STEPS[0].rows <= 128
    assert 360 <= STEPS[-1].rows <= 480


def test_coarse_at_once_then_sharper_after_a_rest(view):
    assert view.due_at() == 10.0
    ticket = view.order()
    assert view.due_at() is None
    assert view.accept(ticket, is_there=True)
    for step in (1, 2):
        assert view.due_at() == 10.0 + REST_S
        ticket = view.order()
        assert ticket.step == step
        assert view.due_at() is None
        assert view.accept(ticket, is_there=True)
    assert view.due_at() is None
    view.moved(20.0)
    assert view.due_at() == 20.0


def test_while_things_move_one_coarse_picture_after_the_other_is_shown(view):
    for number in range(5):
        ticket = view.order()
        view.moved(11.0 + number)
        assert view.due_at() is None  # one at a time
        assert view.accept(ticket, is_there=True)
        assert view.due_at() == 11.0 + number
        assert view.order().step == 0
        view.accept(view.order(), is_there=False)


def test_a_sharp_picture_of_the_past_is_neither_waited_for_nor_shown(view):
    view.accept(view.order(), is_there=True)
    sharp = view.order()
    assert sharp.step == 1
    view.moved(12.0)
    assert view.due_at() == 12.0
    coarse = view.order()
    assert not view.accept(sharp, is_there=False)
    assert not view.accept(sharp, is_there=True)
    assert view.due_at() is None  # the coarse one still comes
    assert view.accept(coarse, is_there=True)


def test_a_sharp_picture_that_comes_after_a_movement_is_not_shown(view):
    view.accept(view.order(), is_there=True)
    sharp = view.order()
    view.moved(12.0)
    assert not view.accept(sharp, is_there=True)
    assert view.due_at() == 12.0


def test_what_did_not_come_is_ordered_again(view):
    assert not view.accept(view.order(), is_there=False)
    assert view.due_at() == 10.0


def test_where_no_picture_can_be_made_nothing_is_due_before_a_movement(view):
    view.give_up(view.order())
    assert view.due_at() is None
    view.moved(13.0)
    assert view.due_at() == 13.0
