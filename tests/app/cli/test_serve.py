import contextlib
import http.client
import json
import logging
import os
import re
import signal
import socket
import sqlite3
import subprocess
import sys
import time
from pathlib import Path

import pytest

from app.cli.main import main
from app.cli.serve import FILE_BYTES, FILES, CannotListen, Serve, ServiceLogFile, bound_socket
from app.storage.database import FILE, Store
from osfcore.errors import InvalidInput
from tests.app.conftest import until
from tests.app.processes.test_child_process import is_running
from tests.support.errors import about

START = "from app.cli.serve import Serve; from pathlib import Path; import sys\nif __name__ == '__main__':\n"


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


def children(process):
    """Process ids of the children of all threads of a process."""
    lists = Path(f"/proc/{process.pid}/task").glob("*/children")
    return [int(pid) for file in lists for pid in file.read_text().split()]


@pytest.mark.slow
@pytest.mark.parametrize("sent", [signal.SIGKILL, signal.SIGHUP])
def test_a_killed_service_leaves_no_process_and_can_start_again(serve, data_dir, sent):
    process = serve(data_dir)
    address(process)
    born = until(lambda: children(process))
    process.send_signal(sent)
    process.wait()
    until(lambda: not any(is_running(pid) for pid in born))
    again = serve(data_dir)
    assert get(address(again), "/api/health") == 200


@pytest.mark.slow
def test_a_second_interrupt_ends_it_and_its_job_at_once(serve, data_dir):
    process = serve(data_dir)
    port = address(process)
    order = {"kind": "collect_table", "params": {"images": 5000, "size": 16}}
    with contextlib.closing(http.client.HTTPConnection("127.0.0.1", port, timeout=60)) as connection:
        connection.request("POST", "/api/jobs", json.dumps(order), {"Content-Type": "application/json"})
        response = connection.getresponse()
        job = json.loads(response.read())["id"]
        assert response.status == 202

        def is_running_now():
            connection.request("GET", f"/api/jobs/{job}")
            return json.loads(connection.getresponse().read())["done"] > 0

        until(is_running_now)
    born = children(process)

    def has_ended():
        process.send_signal(signal.SIGINT)
        time.sleep(0.05)  # several at once would count as one
        return process.poll() is not None

    until(has_ended)
    _, err = process.communicate(timeout=120)
    assert process.returncode in (130, 0)  # it may have stopped before the second one came
    assert "Traceback" not in err
    until(lambda: not any(is_running(pid) for pid in born))
    assert get(address(serve(data_dir)), "/api/health") == 200


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


def test_addresses_that_are_none_are_told():
    for port in (-1, 65536):
        with pytest.raises(InvalidInput, check=about("port")):
            bound_socket("127.0.0.1", port)
    with pytest.raises(CannotListen):
        bound_socket("no.such.host.invalid", 8000)


def test_a_simulator_that_is_not_installed_is_told_at_once(tmp_path, capsys, monkeypatch):
    monkeypatch.setattr("osfcore.world.simulators.find_spec", lambda name: None)
    assert main(["serve", "--port", "0", "--data-dir", str(tmp_path), "--simulator", "mujoco"]) == 1
    assert "mujoco" in capsys.readouterr().err


@pytest.mark.parametrize(
    ("options", "words"),
    [
        (["--robot", "ftp://arm"], "address of the robot is ftp://arm"),
        (["--robot", "http://arm:8080", "--box", "1", "0", "-1", "0"], "safety box"),
        (["--robot", "http://arm:8080", "--top-speed", "0"], "top speed"),
    ],
)
def test_a_robot_that_cannot_be_is_told_at_once(tmp_path, capsys, options, words):
    assert main(["serve", "--port", "0", "--data-dir", str(tmp_path), *options]) == 2
    assert words in capsys.readouterr().err


@pytest.fixture
def open_log(tmp_path):
    """A logger with nothing but the file in a folder."""
    logger = logging.Logger("osf.test")
    handler = ServiceLogFile(tmp_path / "logs" / "service.log")
    logger.addHandler(handler)
    yield logger
    handler.close()


def test_files_are_replaced_in_turn_and_never_grow_beyond_their_share(open_log, tmp_path):
    line = "x" * 10_000
    for number in range(FILE_BYTES * (FILES + 2) // len(line)):
        open_log.warning("%d %s", number, line)
    files = sorted((tmp_path / "logs").iterdir())
    assert [file.name for file in files] == ["service.log", *(f"service.log.{n}" for n in range(1, FILES))]
    assert all(file.stat().st_size <= FILE_BYTES for file in files)
    assert files[0].read_text().splitlines()[-1].startswith(str(number))


def test_a_disk_that_is_full_is_told_once_and_tried_again(open_log, tmp_path, capfd):
    path = tmp_path / "logs" / "service.log"
    os.symlink("/dev/full", path)
    for number in range(200):
        open_log.error("lost %d", number)
    err = capfd.readouterr().err
    assert err == f"{path} cannot be written (No space left on device); logging here alone.\n"
    path.unlink()
    open_log.error("there is room again")
    assert path.read_text() == "there is room again\n"
    assert capfd.readouterr().err == ""


def test_a_folder_that_cannot_be_made_is_told_once(tmp_path, capfd):
    (tmp_path / "logs").write_text("in the way")
    logger = logging.Logger("osf.test")
    logger.addHandler(ServiceLogFile(tmp_path / "logs" / "service.log"))
    for number in range(3):
        logger.error("lost %d", number)
    assert capfd.readouterr().err.count("cannot be written") == 1


def test_a_running_service_is_backed_up_and_comes_back_elsewhere(tmp_path, capsys):
    source, again, archive = (str(tmp_path / name) for name in ("data", "again", "backup.zip"))
    with contextlib.closing(Store(tmp_path / "data")) as store:  # which holds the lock of the directory
        store.save_job("j", 1, {"x": 1})
        assert main(["backup", archive, "--data-dir", source]) == 0
    assert "backup.zip holds 1 files" in capsys.readouterr().out
    assert main(["restore", archive, "--data-dir", again, "--json"]) == 0
    told = json.loads(capsys.readouterr().out.splitlines()[-1])
    assert (told["data_dir"], told["files"]) == (again, 1)
    with contextlib.closing(Store(tmp_path / "again")) as store:
        assert store.jobs() == ((1, {"x": 1}),)


def test_a_target_that_is_not_empty_is_one_sentence(tmp_path, capsys):
    Store(tmp_path / "data").close()
    data, archive = str(tmp_path / "data"), str(tmp_path / "backup.zip")
    assert main(["backup", archive, "--data-dir", data, "--json"]) == 0
    assert json.loads(capsys.readouterr().out)["path"] == archive
    assert main(["restore", archive, "--data-dir", data]) == 2
    error = capsys.readouterr().err
    assert error.startswith("osf: ")
    assert "move this one away" in error


def test_too_little_memory_is_one_sentence_before_anything_begins(tmp_path):
    command = f"ulimit -v 1500000; exec {sys.executable} -m app.cli serve --port 0 --data-dir {tmp_path / 'data'}"
    done = subprocess.run(["sh", "-c", command], capture_output=True, text=True, check=False)
    assert (done.returncode, done.stdout) == (1, "")
    assert "memory" in done.stderr
    assert len(done.stderr.splitlines()) == 1
    assert not (tmp_path / "data").exists()
