import os
import resource
import signal
import time

import pytest

from app.processes.client import ProcessClient, ProcessFrozen, ProcessHangs, ProcessUnavailable
from tests.app.conftest import until

LARGE = bytes(1 << 20)  # more than a pipe holds


def echo_main(server):
    """Answers commands with themselves; a number is slept for."""
    server.serve(lambda command, _: time.sleep(command) if isinstance(command, float) else command)


@pytest.fixture
def echo():
    """Opens clients of the echoing process; all are stopped in the end."""
    opened = []

    def echo(**options):
        client = ProcessClient(echo_main, (), "echo", **options)
        opened.append(client)
        client.start()
        return client

    yield echo
    for client in opened:
        client.stop()


@pytest.mark.slow
def test_nobody_who_sends_to_a_frozen_process_waits(echo):
    client = echo()
    assert client.call("here") == "here"
    frozen = client.process
    os.kill(frozen.pid, signal.SIGSTOP)
    waiting = [client.submit(LARGE) for _ in range(20)]
    assert all(client.notify(LARGE) for _ in range(20))
    assert frozen.is_alive()
    for future in waiting:
        assert isinstance(future.exception(20), ProcessFrozen)
    assert client.call(LARGE) == LARGE
    assert client.process is not frozen


@pytest.mark.slow
@pytest.mark.parametrize("delay_s", [0.0, 0.005, 0.02])
def test_one_that_freezes_in_the_middle_of_an_answer_is_replaced(echo, delay_s):
    client = echo(keeps_running=True)
    waiting = [client.submit(LARGE) for _ in range(40)]
    waiting[0].result(20)
    time.sleep(delay_s)
    frozen = client.process
    os.kill(frozen.pid, signal.SIGSTOP)
    until(lambda: client.process is not frozen and client.status == "ready")
    assert {type(future.exception(20)) for future in waiting} <= {type(None), ProcessFrozen}
    assert client.call("again") == "again"


@pytest.mark.slow
def test_one_that_lives_but_answers_nobody_is_replaced(echo):
    client = echo(answer_s=0.5)
    hanging = client.process
    with pytest.raises(ProcessHangs):
        client.call(60.0)
    assert client.call("again") == "again"
    assert client.process is not hanging


@pytest.mark.slow
def test_one_that_was_stopped_for_a_moment_goes_on(echo):
    client = echo()
    client.call("here")
    process = client.process
    os.kill(process.pid, signal.SIGSTOP)
    waiting = client.submit("later")
    time.sleep(0.4)
    os.kill(process.pid, signal.SIGCONT)
    assert waiting.result(20) == "later"
    assert client.process is process


@pytest.mark.slow
def test_orders_that_nobody_reads_are_refused_in_the_end(echo):
    client = echo()
    client.call("here")
    os.kill(client.process.pid, signal.SIGSTOP)
    assert not all(client.notify(b"order") for _ in range(100_000))


@pytest.mark.slow
def test_one_that_cannot_be_started_for_want_of_descriptors_comes_back(echo):
    client, lazy = echo(keeps_running=True), ProcessClient(echo_main, (), "lazy echo")
    client.call("here")
    soft, hard = resource.getrlimit(resource.RLIMIT_NOFILE)
    resource.setrlimit(resource.RLIMIT_NOFILE, (3, hard))
    try:
        died = client.process
        os.kill(died.pid, signal.SIGKILL)
        until(lambda: client.status == "restarting")
        with pytest.raises(ProcessUnavailable):
            lazy.call("here")
        time.sleep(0.5)
    finally:
        resource.setrlimit(resource.RLIMIT_NOFILE, (soft, hard))
    until(lambda: client.status == "ready")
    assert client.call("again") == "again"
    assert lazy.call("again") == "again"
    lazy.stop()
