import os

import pytest

from app.commands import workers
from app.commands.workers import worker_pool
from osfcore.errors import InvalidInput


def test_one_worker_is_this_process():
    with worker_pool(1) as executor:
        assert executor is None


def test_more_workers_are_other_processes():
    with worker_pool(2) as executor:
        assert executor is not None
        assert executor.submit(os.getpid).result() != os.getpid()


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
