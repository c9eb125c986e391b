import contextlib
import http.client
import os
import re
import signal
import socket
import sqlite3
import subprocess
import sys
from pathlib import Path

import pytest

from app.cli.commands.serve import CannotListen, Serve, bound_socket
from app.cli.main import main
from app.storage.database import FILE
from osfcore.errors import InvalidInput
from tests.app.conftest import until
from tests.app.processes.test_child_process import is_running
from tests.support.errors import about

START = "from app.cli.commands.serve import Serve; from pathlib import Path; import sys\nif __name__ == '__main__':\n"


@pytest.fixture
def serve(tmp_path):
    """Starts the command on a free port; gives process and port. All are ended with the test."""
    script = tmp_path / "serve.py"
    script.write_text(START + "    Serve(port=int(sys.argv[1]), data_dir=Path(sys.argv[2])).run()\n")
    started = []

    def serve(data_dir, port=0):
        process = subprocess.Popen(
            [sys.executable, script, str(port), data_dir],
            stdout=subprocess.PIPE,
            stderr=subprocess.PIPE,
            text=True,
            env={**os.environ, "PYTHONPATH": os.getcwd()},
        )
        started.append(process)
        return process

    yield serve
    for process in started:
        process.kill()
        process.communicate()


def address(process):
    """The port in the one line that the command prints."""
    line = process.stdout.readline()
    match = re.fullmatch(r"http://127\.0\.0\.1:(\d+)\n", line)
    assert match, (line, process.stderr.read())
    return int(match[1])


def get(port, path):
    """Status of one request."""
    with contextlib.closing(http.client.HTTPConnection("127.0.0.1", port, timeout=20)) as connection:
        connection.request("GET", path)
        with connection.getresponse() as response:
            response.read()
            return response.status


@pytest.mark.slow
def test_it_tells_one_address_and_leaves_at_once_with_streams_open(serve, data_dir):
    process = serve(data_dir)
    port = address(process)
    assert get(port, "/api/health") == 200
    stream = http.client.HTTPConnection("127.0.0.1", port, timeout=20)
    stream.request("GET", "/api/events?frames=1")
    events = stream.getresponse()
    assert events.status == 200
    viewer = socket.create_connection(("127.0.0.1", port))
    viewer.sendall(
        b"GET /viewer HTTP/1.1\r\nHost: localhost\r\nUpgrade: websocket\r\nConnection: Upgrade\r\n"
        b"Sec-WebSocket-Key: AAAAAAAAAAAAAAAAAAAAAA==\r\nSec-WebSocket-Version: 13\r\n"
        b"Sec-WebSocket-Protocol: viser-v1.1.1\r\n\r\n"
    )
    assert b"101" in viewer.recv(100)
    process.send_signal(signal.SIGINT)
    out, err = process.communicate(timeout=120)  # the streams stay open for ever
    assert (process.returncode, out, err) == (0, "", "")
    viewer.close()
    events.close()
    stream.close()


@pytest.mark.slow
def test_a_killed_service_leaves_no_process_and_can_start_again(serve, data_dir):
    process = serve(data_dir)
    address(process)

    def children():
        lists = Path(f"/proc/{process.pid}/task").glob("*/children")  # one for each thread
        return [int(pid) for file in lists for pid in file.read_text().split()]

    born = until(children)
    process.kill()
    process.wait()
    until(lambda: not any(is_running(pid) for pid in born))
    again = serve(data_dir)
    assert get(address(again), "/api/health") == 200


def garbage(port):
    """A request that the server logs."""
    with socket.create_connection(("127.0.0.1", port), 20) as client:
        client.sendall(b"no request at all\r\n\r\n")
        client.recv(1000)


@pytest.mark.slow
def test_what_goes_wrong_stands_in_the_log_file_too(serve, data_dir):
    process = serve(data_dir)
    port = address(process)
    garbage(port)
    log = data_dir / "logs" / "service.log"
    assert until(lambda: log.exists() and log.read_text())
    assert re.fullmatch(r"[0-9T:-]+Z WARNING uvicorn.error: Invalid HTTP request received.\n", log.read_text())
    process.send_signal(signal.SIGTERM)
    _, err = process.communicate(timeout=30)
    assert err == log.read_text()


@pytest.mark.slow
def test_a_log_file_that_cannot_be_written_stops_nothing_and_is_told_once(serve, data_dir):
    (data_dir / "logs").mkdir()
    os.symlink("/dev/full", data_dir / "logs" / "service.log")
    process = serve(data_dir)
    port = address(process)
    for _ in range(3):
        garbage(port)
    assert get(port, "/api/health") == 200
    process.send_signal(signal.SIGTERM)
    _, err = process.communicate(timeout=30)
    assert err.count("No space left on device") == 1
    assert err.count("Invalid HTTP request received") == 3
    assert len(err.splitlines()) == 4


@pytest.mark.slow
def test_without_objects_the_page_starts_and_says_how_to_get_them(serve, tmp_path):
    process = serve(tmp_path / "empty")
    port = address(process)
    assert get(port, "/api/scenes") == 200
    process.send_signal(signal.SIGTERM)
    _, err = process.communicate(timeout=30)
    assert "osf assets fetch" in err


@pytest.mark.slow
def test_a_damaged_database_is_put_aside_and_told(serve, data_dir):
    (data_dir / FILE).write_bytes(b"no database" * 1000)
    process = serve(data_dir)
    assert get(address(process), "/api/health") == 200
    process.send_signal(signal.SIGINT)
    _, err = process.communicate(timeout=30)
    assert f"{FILE}.damaged" in err
    assert "Traceback" not in err
    assert (data_dir / f"{FILE}.damaged").read_bytes() == b"no database" * 1000


def test_another_programs_database_stops_it_in_one_sentence(serve, data_dir):
    with contextlib.closing(sqlite3.connect(data_dir / FILE)) as database:
        database.execute("CREATE TABLE other (x)")
    process = serve(data_dir)
    out, err = process.communicate(timeout=30)
    assert out == ""
    assert err.splitlines()[-1].startswith("osfcore.errors.CorruptFile")
    assert "another program" in err


def test_a_senseless_setting_is_told(data_dir, monkeypatch):
    monkeypatch.setenv("OSF_MAX_SCENES", "many")
    with pytest.raises(InvalidInput, check=about("OSF_MAX_SCENES")):
        Serve(port=0, data_dir=data_dir).run()


def test_a_port_in_use_is_told():
    with socket.create_server(("127.0.0.1", 0)) as taken:
        port = taken.getsockname()[1]
        with pytest.raises(CannotListen):
            bound_socket("127.0.0.1", port)


@pytest.mark.parametrize(("host", "port"), [("127.0.0.1", -1), ("127.0.0.1", 65536), ("no.such.host.invalid", 8000)])
def test_addresses_that_are_none_are_told(host, port):
    with pytest.raises(CannotListen):
        bound_socket(host, port)


@pytest.mark.parametrize(
    ("options", "words"),
    [
        (["--robot", "ftp://arm"], "address of the robot is ftp://arm"),
        (["--robot", "http://arm:8080", "--box", "1", "0", "-1", "0"], "safety box"),
        (["--robot", "http://arm:8080", "--top-speed", "0"], "top speed"),
    ],
)
def test_a_robot_that_cannot_be_is_told_at_once(tmp_path, capsys, options, words):
    assert main(["serve", "--port", "0", "--data-dir", str(tmp_path), *options]) == 1
    assert words in capsys.readouterr().err
