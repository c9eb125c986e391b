import asyncio
import contextlib
import os
import shutil
import signal
import time
from concurrent.futures import ThreadPoolExecutor

import numpy as np
import pytest

from app.episodes.settings import ChosenSettings
from app.jobs.job import JobChanged
from app.jobs.kinds.collections import CollectTableParams
from app.jobs.kinds.episodes import EpisodeGoal, EpisodeParams
from app.jobs.kinds.fields import FieldSource, TrainFieldParams
from app.processes.messages.scene_messages import DropScene, SceneChanged, TakeImage
from app.services.event_hub import CurrentScene, Notice
from app.services.runner import DemoScene, Runner, SceneNeeded, TrainingAlready
from app.services.scenes import SceneHeld, TooManyScenes
from app.services.service_settings import Settings
from app.storage.database import FILE, CannotStore, Store
from osfcore.errors import InvalidInput, UnknownName
from osfcore.geometry.light import Light
from osfcore.geometry.poses import Pose
from osfcore.objects.asset_library import AssetLibrary
from tests.app.conftest import full_disk, newest_child, until
from tests.app.jobs.test_registry import LONG
from tests.app.storage.test_database import record
from tests.support.errors import about

BOX = "003_cracker_box"


@pytest.fixture
def open_runner(data_dir):
    """Opens a runner on the data directory, as a service that starts; closed in the end, or by `close`."""
    opened = []

    def close():
        while opened:
            runner, store = opened.pop()
            runner.stop()
            store.close()

    def open_runner(demo=None, **settings):
        close()
        settings = Settings(data_dir=data_dir, **settings)
        store = Store(data_dir)
        runner = Runner(settings, store, AssetLibrary(data_dir / "objects"), demo)
        opened.append((runner, store))
        runner.events = []
        runner.hub.subscribe(runner.events.append)
        runner.start()
        return runner

    yield open_runner
    close()


def simulation_pid():
    """Of the simulation that was started last: services of other tests have theirs."""
    return newest_child("osf-simulation")


def test_the_first_start_shows_a_scene_by_itself(open_runner):
    runner = open_runner()
    until(lambda: runner.scenes.current is not None)
    (record,) = runner.scenes.all()
    assert (record.seed, len(record.state.names)) == (0, 3)
    until(lambda: any(isinstance(event, CurrentScene) for event in runner.events))


@pytest.mark.slow
def test_the_first_scene_is_the_one_that_is_wished_for_where_its_objects_are_there(open_runner, data_dir):
    light = Light.from_angles(1.0, 0.5)
    runner = open_runner(DemoScene((BOX,), 5, light))
    until(lambda: runner.scenes.current is not None)
    (record,) = runner.scenes.all()
    assert (record.seed, record.state.names) == (5, (BOX,))
    assert record.state.light.angle_to(light) < 1e-6
    runner.delete_scene(record.id)
    runner = open_runner(DemoScene((BOX, "nowhere"), 5, light))
    until(lambda: runner.scenes.current is not None)
    assert runner.scenes.all()[0].seed == 0


def test_without_objects_there_is_no_scene_until_some_come(open_runner, data_dir, tmp_path):
    shutil.move(data_dir / "objects", tmp_path / "later")
    runner = open_runner()
    runner.ensure_demo_scene()
    assert runner.scenes.all() == ()
    shutil.move(tmp_path / "later", data_dir / "objects")
    runner.ensure_demo_scene()
    until(runner.scenes.all)


@pytest.mark.slow
def test_everything_is_there_after_a_restart(open_runner):
    runner = open_runner(demo_scene=False)
    first = runner.scenes.create(names=(BOX,), seed=3)
    runner.scenes.create(count=2, seed=4)
    moved = runner.scenes.act(first.id, [(0.1, 0.1, 0.0)] * 2)
    runner.scenes.activate(first.id)
    again = open_runner()
    assert again.scenes.current == first.id
    assert [record.seed for record in again.scenes.all()] == [3, 4]
    found = again.scenes.get(first.id)
    assert found.time_s == moved.time_s
    assert np.array_equal(found.state.poses.position, moved.state.poses.position)
    back = again.scenes.reset(first.id)
    assert np.allclose(back.state.poses.position, first.state.poses.position, atol=1e-9)


@pytest.mark.slow
def test_a_dying_simulation_is_told_and_the_scenes_live_on(open_runner):
    runner = open_runner(demo_scene=False)
    scene = runner.scenes.create(names=(BOX,), seed=3)
    until(lambda: runner.scenes.status == "ready")
    pid = simulation_pid()
    os.kill(pid, signal.SIGKILL)
    until(lambda: simulation_pid() not in (0, pid))
    until(lambda: any(isinstance(event, Notice) and event.level == "error" for event in runner.events))
    until(lambda: runner.scenes.status == "ready")
    assert runner.scenes.act(scene.id, [(0.1, 0, 0)]).revision > scene.revision


def test_scenes_have_a_limit(open_runner):
    runner = open_runner(demo_scene=False, max_scenes=1)
    askew = Pose(np.array([0.0, 0, 0.1]), np.array([0.5, 0, 0, 0]))
    with pytest.raises(InvalidInput, check=about("quaternion")):
        runner.scenes.create(poses=((BOX, askew),))
    runner.scenes.create(names=(BOX,))  # one that was refused does not count
    with pytest.raises(TooManyScenes):
        runner.scenes.create(names=(BOX,))


def test_the_limit_holds_for_scenes_made_at_the_same_time(open_runner):
    runner = open_runner(demo_scene=False, max_scenes=2)

    def make(_):
        try:
            return runner.scenes.create(names=(BOX,))
        except TooManyScenes:
            return None

    with ThreadPoolExecutor(8) as executor:
        made = [record for record in executor.map(make, range(8)) if record is not None]
    assert len(made) == len(runner.scenes.all()) == 2


@pytest.mark.slow
def test_a_busy_simulation_is_not_taken_for_a_hanging_one(open_runner):
    """Each answer comes in time, the last one long after the limit for one answer."""
    runner = open_runner(demo_scene=False)
    scene = runner.scenes.create(names=(BOX,), seed=3)
    single = time.monotonic()
    asyncio.run(runner.scenes.image(TakeImage(scene.id, "0", 700)))
    single = time.monotonic() - single
    limit_s = max(3 * single, 2.0)
    runner = open_runner(demo_scene=False, stage_timeout_s=limit_s)
    until(lambda: runner.scenes.status == "ready")
    pid, count = simulation_pid(), min(int(2 * limit_s / single), 60)

    async def many():
        return await asyncio.gather(*(runner.scenes.image(TakeImage(scene.id, "1", 700 + k)) for k in range(count)))

    images = asyncio.run(many())
    assert len({*images}) == count
    assert simulation_pid() == pid


def test_an_image_that_many_ask_for_at_once_is_made_once(open_runner):
    runner = open_runner(demo_scene=False)
    scene = runner.scenes.create(names=(BOX,), seed=3)

    async def many():
        return await asyncio.gather(*(runner.scenes.image(TakeImage(scene.id, "2", 256)) for _ in range(10)))

    first, *others = asyncio.run(many())
    assert all(other is first for other in others)


def test_changes_are_told_and_refusals_are_not(open_runner):
    runner = open_runner(demo_scene=False)
    scene = runner.scenes.create(names=(BOX,), seed=3)
    runner.events.clear()
    with pytest.raises(InvalidInput):
        runner.scenes.act(scene.id, [(9, 0, 0)])
    with pytest.raises(InvalidInput, check=about("objects")):
        runner.scenes.edit(scene.id, poses=((BOX, Pose.identity()), (BOX, Pose.identity())))
    with pytest.raises(UnknownName):
        runner.scenes.edit("none", light=Light(np.array([0, 0, 1.0])))
    assert not [event for event in runner.events if isinstance(event, SceneChanged)]
    runner.scenes.edit(scene.id, light=Light(np.array([0, 0, 1.0])))
    (change,) = [event for event in runner.events if isinstance(event, SceneChanged)]
    assert np.allclose(change.record.state.light.position, [0, 0, 1])


@pytest.mark.slow
def test_hands_stay_off_a_scene_that_a_job_uses(open_runner):
    runner = open_runner(demo_scene=False)
    scene = runner.scenes.create(names=(BOX,), seed=3)
    job = runner.jobs.submit(LONG[0], dict(LONG[1]))
    until(lambda: runner.jobs.get(job.id).done > 0)
    runner.jobs.change(job.id, {"scene": scene.id})
    for command in (
        lambda: runner.scenes.act(scene.id, [(0.1, 0, 0)]),
        lambda: runner.scenes.reset(scene.id),
        lambda: runner.scenes.edit(scene.id, light=Light(np.array([0, 0, 1.0]))),
    ):
        with pytest.raises(SceneHeld):
            command()


@pytest.mark.slow
@pytest.mark.parametrize("state", ["queued", "running", "paused"])
def test_a_scene_that_a_live_job_needs_cannot_be_deleted_until_it_is_cancelled(open_runner, state):
    runner = open_runner(demo_scene=False)
    scene = runner.scenes.create(names=(BOX,), seed=3)
    busy = runner.jobs.submit(LONG[0], dict(LONG[1]))
    until(lambda: runner.jobs.get(busy.id).done > 0)
    needs = busy
    if state == "queued":
        needs = runner.jobs.submit(LONG[0], {**LONG[1], "scene": scene.id})
    else:
        runner.jobs.change(busy.id, {"scene": scene.id})
    if state == "paused":
        runner.jobs.pause(busy.id)
        runner.scenes.edit(scene.id, light=Light(np.array([0, 0, 1.0])))  # hands may move things meanwhile
    with pytest.raises(SceneNeeded):
        runner.delete_scene(scene.id)
    assert runner.scenes.get(scene.id).id == scene.id
    runner.jobs.cancel(needs.id)
    runner.delete_scene(scene.id)
    assert runner.scenes.all() == ()


def test_a_job_is_not_queued_for_a_scene_that_was_deleted_meanwhile(open_runner):
    runner = open_runner(demo_scene=False)
    goal, settings = EpisodeGoal(id=None), ChosenSettings.defaults()
    params = EpisodeParams(scene="gone", names=(BOX,), seed=0, settings=settings, goal=goal)
    with runner.jobs.new_inputs() as folder:
        folder.mkdir(parents=True)
        with pytest.raises(UnknownName, check=about("scene")):
            runner.submit_with_inputs("episode", params, folder)
    assert runner.jobs.all() == ()


def test_an_image_is_made_once_for_each_revision(open_runner):

    runner = open_runner(demo_scene=False)
    scene = runner.scenes.create(names=(BOX,), seed=3)
    command = TakeImage(scene.id, "0", 64)
    first = asyncio.run(runner.scenes.image(command))
    assert asyncio.run(runner.scenes.image(command)) is first
    runner.scenes.edit(scene.id, light=Light(np.array([0.0, 1.0, 0.2])))
    second = asyncio.run(runner.scenes.image(command))
    assert second != first


def test_jobs_are_told_to_those_who_listen(open_runner):
    runner = open_runner(demo_scene=False)
    job = runner.submit_job("collect_table", CollectTableParams(images=60, size=16))
    until(lambda: runner.jobs.get(job.id).state == "done", 60)
    until(lambda: any(isinstance(e, JobChanged) and e.job.state == "done" for e in runner.events))


def test_one_field_is_ordered_once_however_many_ask_at_once(open_runner, monkeypatch):
    runner = open_runner(demo_scene=False)
    params = TrainFieldParams(name="box", source=FieldSource(mesh=BOX), minutes=10, images=5000)
    submit = runner.jobs.submit
    monkeypatch.setattr(runner.jobs, "submit", lambda *order: (time.sleep(0.05), submit(*order))[1])

    def order(_):
        try:
            return runner.submit_job("train_field", params)
        except TrainingAlready:
            return None

    with ThreadPoolExecutor(6) as executor:
        made = [job for job in executor.map(order, range(6)) if job is not None]
    assert len(made) == len(runner.jobs.live("train_field")) == 1
    runner.jobs.cancel(made[0].id)


def test_a_field_that_was_put_aside_by_a_killed_service_is_back_after_the_next_start(open_runner, data_dir):
    aside = data_dir / "fields" / ".replaced-x" / "mug"
    aside.mkdir(parents=True)
    (aside / "field.safetensors").write_bytes(b"weights")
    open_runner(demo_scene=False)
    assert (data_dir / "fields" / "mug" / "field.safetensors").read_bytes() == b"weights"
    assert not aside.parent.exists()


class PlayedSimulation:
    """A simulation whose part is played by the test; knows the scenes that it was not told to drop."""

    status = "ready"

    def __init__(self, *_, **__):
        self.scenes = set()

    def start(self):
        pass

    stop = start

    def call(self, command):
        self.scenes.add(command.id)
        return record(command.id)

    call_async = call

    def submit(self, command):
        if isinstance(command, DropScene):
            self.scenes.remove(command.id)


def test_a_scene_that_cannot_be_stored_is_nowhere(open_runner, monkeypatch):
    simulations = []
    monkeypatch.setattr(
        "app.services.scenes.ProcessClient", lambda *_, **__: simulations.append(PlayedSimulation()) or simulations[-1]
    )
    runner = open_runner(demo_scene=False)
    shown = runner.scenes.create(names=(BOX,), seed=3)
    runner.events.clear()
    with full_disk(), pytest.raises(CannotStore):
        runner.scenes.create(names=(BOX,), seed=4)
    assert simulations[-1].scenes == {shown.id}
    assert [scene.id for scene in runner.scenes.all()] == [runner.scenes.current] == [shown.id]
    assert (runner.events, runner.unwritten) == ([], 0)
    assert [scene.id for scene in open_runner(demo_scene=False).scenes.all()] == [shown.id]


@pytest.mark.slow
def test_a_push_that_cannot_be_stored_has_happened_and_is_stored_later(open_runner):
    runner = open_runner(demo_scene=False)
    scene = runner.scenes.create(names=(BOX,), seed=3)
    with full_disk():
        moved = runner.scenes.act(scene.id, [(0.1, 0, 0)])
        runner.scenes.activate(scene.id)
        assert runner.unwritten == 2
    assert moved.time_s > scene.time_s
    assert runner.scenes.get(scene.id).time_s == moved.time_s
    until(lambda: runner.unwritten == 0)
    again = open_runner(demo_scene=False)
    assert again.scenes.get(scene.id).time_s == moved.time_s


@pytest.mark.slow
def test_what_a_hand_moves_on_a_full_disk_is_refused_and_undone(open_runner):
    runner = open_runner(demo_scene=False)
    made = runner.scenes.create(names=(BOX,), seed=3, light=Light(np.array([0.0, 0.0, 1.5])))
    moved = runner.scenes.edit(made.id, light=Light(np.array([0.0, 0.5, 1.5])))
    lifted = Pose(made.state.pose(BOX).position + np.array([0.0, 0.1, 0.05]), made.state.pose(BOX).quaternion)
    picture = TakeImage(made.id, "0", 64)

    def seen():
        return asyncio.run(runner.scenes.image(picture))

    before = seen()
    for change in (
        lambda: runner.scenes.edit(made.id, light=Light(np.array([0.5, 0.0, 1.5]))),
        lambda: runner.scenes.edit(made.id, poses=((BOX, lifted),)),
        lambda: runner.scenes.reset(made.id),
    ):
        with full_disk(), pytest.raises(CannotStore):
            change()
        now = runner.scenes.get(made.id)
        assert now.revision > moved.revision
        np.testing.assert_array_equal(now.state.light.position, moved.state.light.position)
        np.testing.assert_allclose(now.state.poses.position, moved.state.poses.position, atol=1e-9)
        assert seen() == before
        assert runner.unwritten == 0
    again = runner.scenes.edit(made.id, light=Light(np.array([0.5, 0.0, 1.5])))
    assert open_runner(demo_scene=False).scenes.get(made.id).revision == again.revision


@pytest.mark.slow
def test_that_the_database_was_deleted_is_a_problem_with_a_reason(open_runner, data_dir):
    runner = open_runner(demo_scene=False)
    scene = runner.scenes.create(names=(BOX,), seed=3)
    (data_dir / FILE).unlink()
    runner.scenes.activate(scene.id)
    assert runner.unwritten == 1
    assert FILE in runner.storing_problem()


def test_what_is_set_aside_at_the_start_is_told(open_runner, data_dir, caplog):
    with contextlib.closing(Store(data_dir)) as store:
        store.save_job("a", 1, {"id": "a"})
    runner = open_runner(demo_scene=False)
    (notice,) = [event for event in runner.events if isinstance(event, Notice)]
    assert notice.level == "warning"
    assert "job a makes no sense" in notice.text
    assert notice.text in caplog.text
    assert runner.jobs.all() == ()
