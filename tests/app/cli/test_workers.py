import os
import subprocess
import sys
import time
from pathlib import Path

import pytest

from app.cli import workers
from app.cli.workers import worker_pool
from osfcore.errors import InvalidInput


def test_one_worker_is_this_process():
    with worker_pool(1) as executor:
        assert executor is None


def test_more_workers_are_other_processes():
    with worker_pool(2) as executor:
        assert executor is not None
        assert executor.submit(os.getpid).result() != os.getpid()


def test_workers_end_with_a_killed_parent(tmp_path):
    script = tmp_path / "parent.py"
    script.write_text(
        "import os, time\n"
        "from app.cli.workers import worker_pool\n"
        "if __name__ == '__main__':\n"
        "    with worker_pool(2) as pool:\n"
        "        print(pool.submit(os.getpid).result(), flush=True)\n"
        "        pool.submit(time.sleep, 600).result()\n"
    )
    parent = subprocess.Popen([sys.executable, str(script)], stdout=subprocess.PIPE, text=True)
    worker = int(parent.stdout.readline())
    parent.kill()
    parent.wait()
    parent.stdout.close()
    deadline = time.monotonic() + 10
    while Path(f"/proc/{worker}").exists() and time.monotonic() < deadline:
        time.sleep(0.05)
    assert not Path(f"/proc/{worker}").exists()


@pytest.mark.parametrize("count", [0, -1, 257])
def test_senseless_numbers_are_refused(count):
    with pytest.raises(InvalidInput, match="number of workers"), worker_pool(count):
        pass


def test_without_shared_memory_this_process_works_alone(monkeypatch):
    def refuse(*args, **kwargs):
        raise PermissionError(13, "Permission denied")

    monkeypatch.setattr(workers, "ProcessPoolExecutor", refuse)
    with worker_pool(2) as executor:
        assert executor is None
