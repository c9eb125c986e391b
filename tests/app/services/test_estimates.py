"""What is taken in and what is refused before any work begins; the work itself is tested through REST."""

import asyncio
import json
import shutil
from dataclasses import replace

import numpy as np
import pytest

from app.jobs.folders import JobFolders
from app.jobs.job import Job, JobPage
from app.jobs.kinds.estimates import STATE
from app.processes.messages.scene_messages import ObservedScene
from app.services.estimates import Asked, Estimates, NoImages, NoPrior, NoScene, Uploaded, errors_of, examine
from app.services.fields import FieldCatalogue, MissingFields
from app.storage.database import now_utc
from app.storage.uploads import UploadRefused
from app.storage.usage import StorageMeter
from osfcore.errors import CorruptFile, InvalidInput, UnknownName
from osfcore.geometry.cameras import default_cameras
from osfcore.geometry.light import Light
from osfcore.geometry.poses import Pose, quaternion_multiply
from osfcore.geometry.states import EstimatedState, Observation, SceneState
from osfcore.io.observation_file import read_observation, write_observation
from osfcore.io.scene_file import write_estimated
from tests.app.services.test_image_sets import zipped
from tests.app.storage.test_database import record
from tests.support.errors import about

BOX, MUSTARD = "003_cracker_box", "006_mustard_bottle"


def seen(names=(BOX, MUSTARD), views=4, masks=True) -> Observation:
    cameras = default_cameras(16)[:views]
    shown = np.zeros((views, len(names), 16, 16), bool)
    shown[0, :, :4] = True
    return Observation(cameras, np.full((views, 16, 16, 3), 0.5), names, shown if masks else None, None, 0.0)


def believed(names=(BOX, MUSTARD)) -> EstimatedState:
    count = len(names)
    poses = Pose(np.zeros((count, 3)), np.tile([1.0, 0, 0, 0], (count, 1)))
    state = SceneState(names, poses, Light(np.array([0, 0, 1.0])), None)
    return EstimatedState(state, np.ones(count), np.ones(count), 0.1, ("",) * count, "")


class Jobs(JobFolders):
    """A registry that never works."""

    def __init__(self, data_dir):
        super().__init__(data_dir)
        self._all = []

    def submit(self, kind, params, inputs=None):
        job = Job(f"job{len(self._all)}", kind, params)
        if inputs is not None:
            shutil.copytree(inputs, self.inputs(job.id))
        self._all.insert(0, job)
        return job

    def all(self):
        return tuple(self._all)

    def page(self, limit, before, kind, fits=lambda _: True):
        shown = [job for job in self._all if job.kind == kind and fits(job)]
        return JobPage(tuple(shown[:limit]), len(shown), None)

    def live(self, kind):
        return tuple(job for job in self._all if job.kind == kind and not job.is_finished)

    def get(self, name, kind=None):
        for job in self._all:
            if job.id == name and kind in (None, job.kind):
                return job
        raise UnknownName(kind, name, [])

    def finish(self, job, state="done", estimate=None):
        ended = replace(job, state=state, finished_at=now_utc())
        self._all[self._all.index(job)] = ended
        if state == "done":
            write_estimated(self.folder(job.id) / STATE, estimate or believed())
        else:
            shutil.rmtree(self.folder(job.id))
        return ended


class Scenes:
    """One scene, whose camera images are grey."""

    simulator = "mujoco"

    def __init__(self):
        self.current, self.names = "s", (BOX, MUSTARD)

    def get(self, scene):
        if scene != "s":
            raise UnknownName("scene", scene, ["s"])
        return replace(record(), id="s", state=believed(self.names).state)

    def observe(self, scene, *, goal, masks):
        observation = seen(self.names, views=1 if goal else 4, masks=masks)
        return ObservedScene(replace(self.get(scene), revision=7), observation)


class Runner:
    """A service with one scene."""

    def __init__(self, data_dir, library):
        self.jobs = Jobs(data_dir)
        self.library = library
        self.scenes = Scenes()
        self.storage = StorageMeter(data_dir)

    def submit_job(self, kind, params):
        return self.jobs.submit(kind, params.to_json())

    def submit_with_inputs(self, kind, params, inputs):
        return self.jobs.submit(kind, params.to_json(), inputs)


@pytest.fixture
def runner(tmp_path, library):
    return Runner(tmp_path, library)


@pytest.fixture
def estimates(runner, tmp_path):
    estimates = Estimates(runner, FieldCatalogue(tmp_path, lambda: ()))
    yield estimates
    estimates.stop()


def archive(tmp_path, observation=None, **files):
    folder = tmp_path / "seen"
    write_observation(folder, observation or seen())
    for name, text in files.items():
        (folder / name.replace("_json", ".json")).write_text(text)
    return zipped(folder)


def upload(estimates, data, asked=None):
    async def chunks():
        yield data

    return asyncio.run(estimates.of_upload(asked or Asked(), chunks(), "seen.zip"))


def left_over(tmp_path):
    return list((tmp_path / "collections").glob(".new-*"))


# Scenes


def test_a_scene_is_looked_at_with_masks_and_the_truth_stays_outside_the_observation(estimates, runner, tmp_path):
    job = estimates.of_scene(Asked(seed=3))
    assert job.kind == "estimate"
    assert job.params["of"] == {"scene": "s", "revision": 7, "file_name": None}
    assert (job.params["mode"], job.params["seed"]) == ("first", 3)
    assert (job.params["names"], job.params["cameras"]) == ([BOX, MUSTARD], ["0", "1", "2", "3"])
    inputs = runner.jobs.inputs(job.id)
    assert {path.name for path in inputs.iterdir()} == {"observation", "truth.json"}
    assert read_observation(inputs / "observation").masks is not None
    told = json.dumps(job.params) + (inputs / "observation" / "observation.json").read_text()
    assert "quaternion" not in told
    assert "light" not in told
    assert left_over(tmp_path) == []


def test_later_frames_and_goals_begin_with_the_latest_estimate_of_the_scene(estimates, runner):
    with pytest.raises(NoPrior):
        estimates.of_scene(Asked("next"))
    first = estimates.of_scene(Asked())
    with pytest.raises(NoPrior):
        estimates.of_scene(Asked("goal"))  # it is not done
    with pytest.raises(InvalidInput, check=about("status")):
        estimates.of_scene(Asked("goal", prior=first.id))
    runner.jobs.finish(first)
    later = estimates.of_scene(Asked("next"))
    inputs = runner.jobs.inputs(later.id)
    assert read_observation(inputs / "observation").masks is None
    assert (inputs / "prior.json").read_text() == (runner.jobs.folder(first.id) / STATE).read_text()
    goal = estimates.of_scene(Asked("goal", prior=first.id))
    assert goal.params["cameras"] == ["0"]
    runner.jobs.finish(runner.jobs.get(goal.id))
    with pytest.raises(UnknownName, check=about("estimate")):
        estimates.of_scene(Asked("next", prior="x"))
    runner.scenes.names = (MUSTARD,)
    with pytest.raises(InvalidInput, check=about("objects")):
        estimates.of_scene(Asked("next"))


def test_scenes_that_cannot_be_estimated_are_told(estimates, runner, tmp_path):
    with pytest.raises(UnknownName, check=about("scene")):
        estimates.of_scene(Asked(), "t")
    with pytest.raises(InvalidInput, check=about("seed")):
        estimates.of_scene(Asked(seed=-1))
    runner.scenes.names = (BOX, "spoon")
    with pytest.raises(MissingFields):
        estimates.of_scene(Asked())
    runner.scenes.current = None
    with pytest.raises(NoScene):
        estimates.of_scene(Asked())
    assert left_over(tmp_path) == []


# Uploads


@pytest.mark.slow
def test_an_uploaded_folder_is_taken_in_with_its_prior(estimates, runner, tmp_path):
    job = upload(estimates, archive(tmp_path))
    assert job.params["of"] == {"scene": None, "revision": None, "file_name": "seen.zip"}
    assert read_observation(runner.jobs.inputs(job.id) / "observation").names == (BOX, MUSTARD)
    assert estimates.simulation_errors(runner.jobs.finish(job)) is None
    write_estimated(tmp_path / "prior.json", believed())
    data = archive(tmp_path, seen(views=1, masks=False), prior_json=(tmp_path / "prior.json").read_text())
    goal = upload(estimates, data, Asked("goal"))
    assert (runner.jobs.inputs(goal.id) / "prior.json").is_file()
    write_estimated(runner.jobs.folder(job.id) / STATE, believed((MUSTARD, BOX)))  # another order
    later = upload(estimates, archive(tmp_path, seen(masks=False)), Asked("next", prior=job.id))
    assert (runner.jobs.inputs(later.id) / "prior.json").is_file()
    assert left_over(tmp_path) == []


def empty_mask():
    observation = seen()
    observation.masks[:, 1] = False
    return observation


@pytest.mark.slow
@pytest.mark.parametrize(
    ("observation", "asked", "kind", "words"),
    [
        (seen(masks=False), Asked(), InvalidInput, "masks of the first frame is missing, but it must be given"),
        (empty_mask(), Asked(), InvalidInput, f"mask of {MUSTARD} is empty in every view"),
        (seen(("spoon",)), Asked(), UnknownName, "no field named 'spoon'"),
        (seen(), Asked("goal", prior="x"), InvalidInput, "number of views of a goal is 4, but it must be 1"),
        (seen(), Asked("next"), NoPrior, "in the archive .prior.json. or named in the request"),
        (seen(), Asked("next", prior="x"), UnknownName, "no estimate named 'x'"),
    ],
)
def test_observations_that_do_not_fit_are_refused_at_once(estimates, tmp_path, observation, asked, kind, words):
    with pytest.raises(kind, match=words):
        upload(estimates, archive(tmp_path, observation), asked)
    assert estimates.all() == ()
    assert left_over(tmp_path) == []


def larger_image(folder):
    write_observation(
        folder.parent / "large",
        replace(seen(), cameras=default_cameras(32), images=np.zeros((4, 32, 32, 3)), masks=None),
    )
    shutil.copy(folder.parent / "large" / "image_2.png", folder / "image_2.png")


@pytest.mark.slow
@pytest.mark.parametrize(
    ("damage", "words"),
    [
        (larger_image, "^image_2.png cannot be used: it is 32 x 32 px; 16 x 16 px as camera 2 is expected"),
        (lambda folder: (folder / "mask_0_1.png").unlink(), "^mask_0_1.png cannot be used: there is no such file"),
        (lambda folder: (folder / "image_0.png").write_bytes(b"no image"), "^image_0.png cannot be used: it is no PNG"),
        (lambda folder: (folder / "observation.json").write_text("{"), "^observation.json cannot be used: it is not v"),
        (lambda folder: (folder / "observation.json").unlink(), "^The uploaded file cannot be used: it holds no obs"),
        (lambda folder: (folder / "prior.json").write_text("{}"), "^prior.json cannot be used"),
        (lambda folder: write_estimated(folder / "prior.json", believed((BOX,))), "objects of prior.json is 003"),
    ],
)  # fmt: skip
def test_damaged_uploads_are_told_in_one_sentence_that_knows_only_the_uploaders_names(
    estimates, tmp_path, damage, words
):
    folder = tmp_path / "seen"
    write_observation(folder, seen())
    damage(folder)
    with pytest.raises(UploadRefused, match=words) as refusal:
        upload(estimates, zipped(folder))
    assert str(tmp_path) not in str(refusal.value)
    assert "\n" not in str(refusal.value)
    assert left_over(tmp_path) == []


def test_what_was_found_in_an_upload_is_told(tmp_path):
    (tmp_path / "new").mkdir()
    (tmp_path / "new" / "observation.zip").write_bytes(archive(tmp_path, empty_mask()))
    assert examine(tmp_path / "new") == Uploaded((BOX, MUSTARD), ("0", "1", "2", "3"), True, (MUSTARD,), False)


# Telling


def test_the_errors_are_against_the_scene_as_it_was_seen(estimates, runner):
    job = estimates.of_scene(Asked())
    assert estimates.simulation_errors(job) is None
    assert estimates.result(job) is None
    moved = believed()
    moved.state.poses.position[0] = [0.003, 0.004, 0]
    done = runner.jobs.finish(job, estimate=moved)
    errors = estimates.simulation_errors(done)
    assert [error["position_mm"] for error in errors["objects"]] == pytest.approx([5, 0])
    assert estimates.result(done).trusted


def test_images_are_of_cameras_and_steps_that_exist(estimates, runner):
    job = estimates.of_scene(Asked())
    assert estimates.observed(job, 2).read_bytes().startswith(b"\x89PNG")
    with pytest.raises(UnknownName, check=about("view")):
        estimates.observed(job, 4)
    with pytest.raises(NoImages):
        estimates.comparison(job, 0)
    guesses = [{"objects": [], "light": {"position": [x, 0, 1]}} for x in (0.0, 1.0)]
    lines = [json.dumps({"step": n, "guess": guess}) for n, guess in enumerate(guesses, 1)]
    (runner.jobs.folder(job.id) / "steps.jsonl").write_text("\n".join(lines) + "\n")
    assert estimates.comparison(job, 1, 1).state.light.position[0] == 0
    latest = estimates.comparison(job, 1)
    assert latest.state.light.position[0] > 0
    assert latest.camera.name == "1"
    assert latest.observed == estimates.observed(job, 1).read_bytes()
    with pytest.raises(UnknownName, check=about("step")):
        estimates.comparison(job, 1, 3)
    estimates.observed(job, 1).unlink()
    with pytest.raises(NoImages):
        estimates.comparison(job, 1)
    with pytest.raises(NoImages):
        estimates.observed(runner.jobs.finish(job, "cancelled"), 0)


def test_a_result_that_was_damaged_is_told(estimates, runner):
    done = runner.jobs.finish(estimates.of_scene(Asked()))
    (runner.jobs.folder(done.id) / STATE).write_text("{}")
    with pytest.raises(CorruptFile, check=about(STATE)):
        estimates.result(done)


BOX, BOWL = "003_cracker_box", "024_bowl"
QUARTER = np.array([0.5**0.5, 0, 0, 0.5**0.5])  # about z


def state(positions, quaternions, light):
    return SceneState((BOX, BOWL), Pose(np.array(positions), np.array(quaternions)), Light(np.array(light)), None)


def test_errors_are_told_in_units_for_people_and_what_looks_alike_is_no_error(library):
    lying = [[0.1, 0.2, 0.3], [0.0, 0.1, 0.0]]
    truth = state(lying, [QUARTER, QUARTER], [0, 0, 1.0])
    turned = [quaternion_multiply(QUARTER, QUARTER)] * 2
    found = state(lying + np.array([[0.003, 0.004, 0], [0, 0, 0.001]]), turned, [1.0, 0, 1.0])
    told = errors_of(found, truth, library)
    assert [error["name"] for error in told["objects"]] == [BOX, BOWL]
    assert [error["position_mm"] for error in told["objects"]] == pytest.approx([5, 1])
    assert told["objects"][0]["rotation_deg"] == pytest.approx(90)
    assert told["objects"][1]["rotation_deg"] == pytest.approx(0, abs=1e-4)  # bowls turn freely
    assert told["light_deg"] == pytest.approx(45)


def test_objects_are_compared_by_name(library):
    truth = state([[0.1, 0, 0], [0, 0.1, 0]], [QUARTER, QUARTER], [0, 0, 1.0])
    swapped = SceneState((BOWL, BOX), truth.poses[[1, 0]], truth.light, None)
    told = errors_of(swapped, truth, library)
    assert [error["position_mm"] for error in told["objects"]] == pytest.approx([0, 0])
    assert told["light_deg"] == pytest.approx(0)
