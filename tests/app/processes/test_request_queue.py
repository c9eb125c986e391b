import threading

from app.processes.messages.neural_messages import CompareView, DrawView
from app.processes.server import Request, RequestQueue


def draw(number, key, *, is_sharp=False):
    return Request(number, DrawView(key, None, None, is_sharp))


def compare(number):
    return Request(number, CompareView(f"compare-{number}", None, None, b""))


def test_the_newest_order_of_a_visitor_wins():
    queue = RequestQueue()
    assert queue.put(draw(1, "a")) is None
    assert queue.put(draw(2, "b")) is None
    assert queue.put(draw(3, "a")).number == 1
    assert [queue.take().number, queue.take().number] == [3, 2]


def test_an_order_at_work_is_overtaken_by_a_newer_one_of_its_visitor_only():
    queue = RequestQueue()
    queue.put(draw(1, "a", is_sharp=True))
    order = queue.take()
    queue.put(draw(2, "b"))
    assert not queue.is_overtaken(order)
    queue.put(draw(3, "a"))
    assert queue.is_overtaken(order)


def test_views_that_move_come_before_comparisons_and_those_before_views_that_rest():
    queue = RequestQueue()
    for order in (draw(1, "a", is_sharp=True), compare(2), compare(3), draw(4, "b"), draw(5, "c")):
        queue.put(order)
    assert [queue.take().number for _ in range(5)] == [4, 5, 2, 3, 1]


def test_closing_lets_the_renderer_go():
    queue, taken = RequestQueue(), []
    waiting = threading.Thread(target=lambda: taken.append(queue.take()))
    waiting.start()
    queue.close()
    waiting.join(5)
    assert taken == [None]
    assert queue.is_overtaken(draw(1, "a"))
