import threading

from app.processes.neural_messages import CompareView, DrawView, NumberedOrder
from app.processes.request_queue import Inbox


def draw(number, key, *, is_sharp=False):
    return NumberedOrder(number, DrawView(key, None, None, is_sharp))


def compare(number):
    return NumberedOrder(number, CompareView(f"compare-{number}", None, None, b""))


def test_the_newest_order_of_a_visitor_wins():
    inbox = Inbox()
    assert inbox.put(draw(1, "a")) is None
    assert inbox.put(draw(2, "b")) is None
    assert inbox.put(draw(3, "a")).number == 1
    assert [inbox.take().number, inbox.take().number] == [3, 2]


def test_an_order_at_work_is_overtaken_by_a_newer_one_of_its_visitor_only():
    inbox = Inbox()
    inbox.put(draw(1, "a", is_sharp=True))
    order = inbox.take()
    inbox.put(draw(2, "b"))
    assert not inbox.is_overtaken(order)
    inbox.put(draw(3, "a"))
    assert inbox.is_overtaken(order)


def test_views_that_move_come_before_comparisons_and_those_before_views_that_rest():
    inbox = Inbox()
    for order in (draw(1, "a", is_sharp=True), compare(2), compare(3), draw(4, "b"), draw(5, "c")):
        inbox.put(order)
    assert [inbox.take().number for _ in range(5)] == [4, 5, 2, 3, 1]


def test_closing_lets_the_renderer_go():
    inbox, taken = Inbox(), []
    waiting = threading.Thread(target=lambda: taken.append(inbox.take()))
    waiting.start()
    inbox.close()
    waiting.join(5)
    assert taken == [None]
    assert inbox.is_overtaken(draw(1, "a"))
