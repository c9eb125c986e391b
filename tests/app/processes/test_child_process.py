import os
import resource
import signal
import subprocess
import sys
import time

import pytest

from app.processes.child_process import end, import_quietly, launch, limit_memory, silence_stdout
from tests.app.conftest import until


def echo(connection, greeting):
    silence_stdout()
    os.write(1, b"nobody reads this")
    connection.send((greeting, os.getpid(), signal.SIGINT in signal.pthread_sigmask(signal.SIG_BLOCK, ())))
    connection.recv()


def with_child(connection):
    child = subprocess.Popen([sys.executable, "-c", "import time; time.sleep(600)"])
    connection.send(child.pid)
    time.sleep(600)


def with_little_memory(connection):
    limit_memory(256 << 20)
    connection.send(len(bytearray(64 << 20)))
    try:
        bytearray(512 << 20)
    except MemoryError:
        connection.send("refused")


def is_running(pid):
    try:
        with open(f"/proc/{pid}/stat") as file:
            return file.read().rsplit(")", 1)[1].split()[0] != "Z"
    except FileNotFoundError:
        return False


@pytest.mark.slow
def test_children_do_not_see_interrupts_and_leave_by_themselves(capfd):
    process, connection = launch(echo, "echo", "hello")
    greeting, pid, is_blocked = connection.recv()
    assert (greeting, pid, is_blocked) == ("hello", process.pid, True)
    assert signal.SIGINT not in signal.pthread_sigmask(signal.SIG_BLOCK, ())
    connection.send(None)
    end(process, 10)
    assert process.exitcode == 0
    end(process)
    connection.close()
    assert capfd.readouterr().out == ""


@pytest.mark.slow
def test_ending_takes_grandchildren_along():
    process, connection = launch(with_child, "parent")
    child = connection.recv()
    assert is_running(child)
    end(process)
    assert process.exitcode == -signal.SIGKILL
    until(lambda: not is_running(child))
    connection.close()


@pytest.mark.slow
def test_ending_needs_no_file_descriptor():
    process, connection = launch(with_child, "parent")
    child = connection.recv()
    soft, hard = resource.getrlimit(resource.RLIMIT_NOFILE)
    resource.setrlimit(resource.RLIMIT_NOFILE, (3, hard))
    try:
        end(process)
    finally:
        resource.setrlimit(resource.RLIMIT_NOFILE, (soft, hard))
    assert process.exitcode == -signal.SIGKILL
    os.kill(child, signal.SIGKILL)  # of whom nothing could be read
    connection.close()


def test_a_quiet_import_still_fails_loudly(capfd):
    import_quietly("json")
    with pytest.raises(ModuleNotFoundError):
        import_quietly("no_such_module")
    os.write(2, b"heard")
    assert capfd.readouterr().err == "heard"


@pytest.mark.slow
def test_memory_beyond_the_limit_is_refused():
    process, connection = launch(with_little_memory, "little")
    assert (connection.recv(), connection.recv()) == (64 << 20, "refused")
    end(process, 10)
    connection.close()
