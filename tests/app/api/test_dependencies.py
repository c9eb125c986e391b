import asyncio
import shutil
import threading
import urllib.request
from concurrent.futures import ThreadPoolExecutor

import pytest

from app.api.dependencies import Lane, ObjectCatalogue
from app.processes.client import ProcessBusy
from osfcore.objects.asset_library import AssetLibrary
from osfcore.objects.catalogue import CATALOGUE
from tests.app.conftest import until


def test_new_objects_are_seen_soon(data_dir, tmp_path):
    library = AssetLibrary(tmp_path / "catalogue")
    catalogue = ObjectCatalogue(library)
    assert catalogue.names() == ()
    assert catalogue.labels()["025_mug"] == CATALOGUE["025_mug"].label
    shutil.copytree(data_dir / "objects", library.root)
    until(lambda: catalogue.names() == library.names())


def test_a_lane_refuses_what_it_cannot_take_in_and_recovers():
    free, lane = threading.Event(), Lane("test", threads=2, waiting=3)

    async def use():
        inside = [asyncio.ensure_future(lane.run(free.wait, 20)) for _ in range(5)]
        await asyncio.sleep(0)
        with pytest.raises(ProcessBusy):
            await lane.run(free.wait)
        free.set()
        assert await asyncio.gather(*inside) == [True] * 5
        await asyncio.sleep(0)
        assert await lane.run(sum, (1, 2)) == 3

    asyncio.run(use())
    lane.close()


def test_a_place_is_free_again_when_the_work_is_done_and_not_when_its_client_leaves():
    free, lane = threading.Event(), Lane("test", threads=1, waiting=0)

    async def use():
        left = asyncio.ensure_future(lane.run(free.wait, 20))
        await asyncio.sleep(0)
        left.cancel()
        with pytest.raises(ProcessBusy):
            await lane.run(free.wait)
        free.set()
        while True:
            try:
                return await lane.run(sum, (1, 2))
            except ProcessBusy:
                await asyncio.sleep(0.01)

    assert asyncio.run(use()) == 3
    lane.close()


def test_what_errors_say_comes_through():
    lane = Lane("test", threads=1, waiting=0)
    with pytest.raises(ZeroDivisionError):
        asyncio.run(lane.run(divmod, 1, 0))
    lane.close()


def test_while_slow_requests_wait_health_answers_and_work_can_be_ended(live, monkeypatch):
    """A hundred pushes of a simulation that hangs: far more than there are threads."""
    free, runner = threading.Event(), live.services.runner
    _, scene = live.request("POST", "/api/scenes", {"seed": 1, "count": 1})
    monkeypatch.setattr(runner.scenes, "act", lambda *_: free.wait(60) and runner.scenes.get(scene["id"]))
    push = f"/api/scenes/{scene['id']}/actions"
    with ThreadPoolExecutor(100) as pushers:
        pushes = [pushers.submit(live.request, "POST", push, {"actions": [[0.1, 0, 0]]}) for _ in range(100)]
        try:
            refused = until(lambda: [push.result() for push in pushes if push.done()])
            assert {status for status, _ in refused} == {503}
            assert live.request("GET", "/api/health")[1]["stage"] == "ready"
            _, job = live.request("POST", "/api/jobs", {"kind": "collect_table", "params": {"images": 5000}})
            assert live.request("DELETE", f"/api/jobs/{job['id']}")[1]["state"] == "cancelled"
        finally:
            free.set()
    statuses = [push.result()[0] for push in pushes]
    assert statuses.count(200) == 72
    live.request("DELETE", f"/api/scenes/{scene['id']}")


def test_pages_that_do_not_read_are_bounded_in_number(live):
    streams = []
    try:
        for _ in range(100):
            streams.append(urllib.request.urlopen(f"{live.url}/api/events", timeout=10))
        status, problem = live.request("GET", "/api/events")
        assert status == 503
        assert "close one" in problem["detail"]
    finally:
        for stream in streams:
            stream.close()
    until(lambda: _can_follow(live.url))


def _can_follow(url):
    try:
        urllib.request.urlopen(f"{url}/api/events", timeout=10).close()
    except OSError:
        return False
    return True
