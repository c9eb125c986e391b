import logging

from app.services.event_hub import Hub


def test_everyone_hears_everything_until_leaving():
    hub, first, second = Hub(), [], []
    leave = hub.subscribe(first.append)
    hub.subscribe(second.append)
    hub.publish(1)
    leave()
    leave()
    hub.publish(2)
    assert (first, second) == ([1], [1, 2])


def test_one_that_fails_does_not_keep_others_from_hearing(caplog):
    hub, heard = Hub(), []

    def fail(event):
        raise RuntimeError("no")

    hub.subscribe(fail)
    hub.subscribe(heard.append)
    with caplog.at_level(logging.ERROR):
        hub.publish("x")
    assert heard == ["x"]
    assert "listener failed" in caplog.text
