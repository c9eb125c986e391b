import json
import os
import signal
import subprocess
import sys
from functools import partial
from pathlib import Path

import numpy as np
import pytest

from app.cli import workers
from app.cli.train import TrainFieldCommand
from app.cli.workers import worker_pool
from osfcore.errors import InvalidInput, OsfError, WorkerDied
from osfcore.experiments.harness import Piece, TaskCache, results_of
from osfcore.fields.devices import computing_threads
from osfcore.fields.kiloosf import read_field
from osfcore.fields.train_kiloosf import TrainField, train_field
from osfcore.fields.train_several import train_several
from osfcore.io.push_file import read_pushes
from osfcore.world.collect_pushes import CollectPushes, collect_pushes
from tests.app.conftest import until
from tests.clusters import deadly, local_cluster, number_of, number_that_kills, training_that_dies
from tests.support.errors import about
from tests.support.rendered_sets import QUICK, painted_ball, painted_block, write_object_set


def test_one_worker_is_this_process():
    with worker_pool(1) as executor:
        assert executor is None


def test_more_workers_are_other_processes():
    with worker_pool(2) as executor:
        assert executor is not None
        assert executor.submit(os.getpid).result() != os.getpid()


@pytest.mark.slow
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
    until(lambda: not Path(f"/proc/{worker}").exists())


INTERRUPTED = """
import os, signal, sys, time
from app.cli.workers import worker_pool

def interrupting():
    os.kill(os.getppid(), signal.SIGINT)
    time.sleep(600)

if __name__ == "__mp_main__" and sys.argv[1] == "starting":
    os.killpg(os.getpgid(0), signal.SIGINT)
if __name__ == "__main__":
    try:
        with worker_pool(2) as pool:
            pool.submit(interrupting).result()
    except KeyboardInterrupt:
        print("interrupted")
"""


@pytest.mark.parametrize("when", ["starting", "working"])
def test_an_interruption_ends_workers_at_once_and_without_a_word(tmp_path, when):
    """As from a terminal while workers start, or of the command alone while they work."""
    script = tmp_path / "parent.py"
    script.write_text(INTERRUPTED)
    env = {**os.environ, "PYTHONPATH": os.getcwd()}
    command = [sys.executable, str(script), when]
    with subprocess.Popen(
        command, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True, start_new_session=True, env=env
    ) as process:
        try:
            told = process.communicate(timeout=120)
        finally:
            if process.poll() is None:
                os.killpg(process.pid, signal.SIGKILL)
    assert (process.returncode, *told) == (0, "interrupted\n", "")


@pytest.mark.parametrize("count", [0, -1, 257])
def test_senseless_numbers_are_refused(count):
    with pytest.raises(InvalidInput, check=about("number of workers")), worker_pool(count):
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


@pytest.fixture(scope="module")
def sets(tmp_path_factory):
    folder = tmp_path_factory.mktemp("sets")
    solids = {"ball": painted_ball(), "block": painted_block()}
    return tuple(write_object_set(folder / name, solid, train=12, test=2) for name, solid in solids.items())


def trainings(sets, folder):
    return [TrainField(one, folder / f"{one.name}.safetensors", iterations=10, device="cpu") for one in sets]


@pytest.mark.slow
def test_fields_from_a_cluster_are_those_of_one_process(cluster, sets, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)  # workers have a place of their own
    here, there = trainings(sets, Path("here")), trainings([Path(os.path.relpath(one)) for one in sets], Path("there"))
    train = partial(train_field, recipe=QUICK)
    with computing_threads(1):
        list(train_several(here, train))
    with worker_pool(1, cluster) as executor:
        list(train_several(there, train, executor, shares_disk=False))
    for one, other in zip(here, there, strict=True):
        a, b = (json.loads(settings.out.with_suffix(".json").read_text()) for settings in (one, other))
        assert (a["iterations"], a["threads"]) == (b["iterations"], b["threads"]) == (10, 1)
        assert a["psnr_full"] == pytest.approx(b["psnr_full"], abs=0.1)
        np.testing.assert_allclose(read_field(one.out).networks, read_field(other.out).networks, atol=0.02)
    assert sorted(path.name for path in Path("there").iterdir()) == [
        "ball.json", "ball.safetensors", "block.json", "block.safetensors",
    ]  # fmt: skip


@pytest.mark.slow
def test_a_worker_that_is_killed_costs_no_field(cluster, sets, tmp_path):
    train = partial(training_that_dies, name="ball", mark=tmp_path / "mark")
    settings = trainings(sets, tmp_path)
    with worker_pool(1, cluster) as executor:
        *_, last = train_several(settings, train, executor, shares_disk=False)
    assert (tmp_path / "mark").exists()
    assert (last.done, last.total) == (2, 2)
    assert all(read_field(one.out).hidden == QUICK.hidden for one in settings)


@pytest.mark.slow
def test_a_field_is_ordered_from_a_cluster(cluster, sets, tmp_path, capsys):
    command = TrainFieldCommand(sets[:1], tmp_path / "mine.safetensors", iterations=10, device="cpu", cluster=cluster)
    result = command.run()
    assert result == {"out": str(command.out), **json.loads(command.out.with_suffix(".json").read_text())}
    assert f"{result['psnr_mask']:.1f} dB in the mask" in capsys.readouterr().out
    assert command.run() == result  # it is there: minutes would differ


@pytest.mark.slow  # after all others: Dask does not replace a worker that dies while it is being started
def test_work_that_kills_every_worker_is_told(cluster, tmp_path):
    with pytest.raises(WorkerDied):
        results(worker_pool(1, cluster), pieces_of(tmp_path, [partial(deadly, 0)]))


@pytest.mark.parametrize("address", ["tcp://127.0.0.1:1", "nowhere", "tcp://127.0.0.1:99999999"])
def test_an_address_where_nothing_answers_is_told(address):
    pool = worker_pool(2, address, answers_within_s=0.3)
    with pytest.raises(InvalidInput, check=about("address of the cluster")), pool:
        pass


def test_without_dask_it_is_said_how_to_get_it(monkeypatch):
    monkeypatch.setitem(sys.modules, "distributed", None)
    with pytest.raises(OsfError, match=r"osf-manipulation\[cluster\]"), worker_pool(2, "tcp://127.0.0.1:8786"):
        pass
