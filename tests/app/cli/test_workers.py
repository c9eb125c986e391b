import os
import subprocess
import sys
import time
from functools import partial
from pathlib import Path

import numpy as np
import pytest

from app.cli import workers
from app.cli.workers import worker_pool
from osfcore.errors import InvalidInput, OsfError, WorkerDied
from osfcore.experiments.pieces import Piece, results_of
from osfcore.experiments.task_cache import TaskCache
from osfcore.io.push_file import read_pushes
from osfcore.world.collection.collect_pushes import CollectPushes, collect_pushes
from tests.clusters import deadly, local_cluster, number_of, number_that_kills


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


@pytest.fixture(scope="module")
def cluster(tmp_path_factory):
    with local_cluster(tmp_path_factory.mktemp("dask")) as address:
        yield address


def results(pool, pieces):
    with pool as executor:
        *_, last = results_of(pieces, executor)
    return [result.figures["number"] for result in last]


def pieces_of(folder, works):
    return [Piece(f"{n:02d}", TaskCache(folder), {}, work) for n, work in enumerate(works)]


@pytest.mark.slow
def test_a_cluster_gives_the_same_numbers(cluster, tmp_path):
    works = [partial(number_of, n) for n in range(8)]
    expected = results(worker_pool(1), pieces_of(tmp_path / "alone", works))
    assert results(worker_pool(1, cluster), pieces_of(tmp_path / "cluster", works)) == expected == list(range(8))


@pytest.mark.slow
def test_a_worker_of_a_cluster_that_is_killed_costs_no_result(cluster, tmp_path):
    works = [partial(number_of, n) for n in range(4)]
    works.insert(1, partial(number_that_kills, 9, tmp_path / "mark"))
    assert results(worker_pool(1, cluster), pieces_of(tmp_path / "kept", works)) == [0, 9, 1, 2, 3]
    assert (tmp_path / "mark").exists()


@pytest.mark.slow
def test_work_that_kills_every_worker_is_told(cluster, tmp_path):
    with pytest.raises(WorkerDied, match="worker process died"):
        results(worker_pool(1, cluster), pieces_of(tmp_path, [partial(deadly, 0)]))


@pytest.mark.slow
def test_pushes_from_a_cluster_are_the_same_to_the_last_bit(cluster, library, tmp_path):
    for name, pool in (("alone", worker_pool(1)), ("cluster", worker_pool(1, cluster))):
        config = CollectPushes(tmp_path / f"{name}.h5", episodes=4, steps=5, objects=2, policy="directed")
        with pool as executor:
            for _ in collect_pushes(config, library, executor):
                pass
    alone, shared = (list(read_pushes(tmp_path / f"{name}.h5")) for name in ("alone", "cluster"))
    for one, other in zip(alone, shared, strict=True):
        assert one.names == other.names
        np.testing.assert_array_equal(one.positions, other.positions)
        np.testing.assert_array_equal(one.actions, other.actions)


@pytest.mark.parametrize("address", ["tcp://127.0.0.1:1", "nowhere", "tcp://127.0.0.1:99999999"])
def test_an_address_where_nothing_answers_is_told(address):
    pool = worker_pool(2, address, answers_within_s=0.3)
    with pytest.raises(InvalidInput, match="address of the cluster"), pool:
        pass


def test_without_dask_it_is_said_how_to_get_it(monkeypatch):
    monkeypatch.setitem(sys.modules, "distributed", None)
    with pytest.raises(OsfError, match=r"osf-manipulation\[cluster\]"), worker_pool(2, "tcp://127.0.0.1:8786"):
        pass
