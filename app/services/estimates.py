"""Estimates of poses and light: taking in what is to be estimated, and telling what came of it.

The work is a job (`estimate_job`). What it gets is an observation folder, of a scene of the simulation or uploaded. The
truth of a scene stays beside that folder, where only this module reads it, after the work.
"""

from __future__ import annotations

import uuid
from collections.abc import AsyncIterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from starlette.concurrency import run_in_threadpool

from osfcore.errors import InvalidInput, OsfError, UnknownName, check_known, check_seed
from osfcore.geometry.cameras import Camera
from osfcore.geometry.states import EstimatedState, SceneState
from osfcore.io.files import read_json, write_json, writing
from osfcore.io.json_codec import decode
from osfcore.io.observation_file import OBSERVATION_FILE, ObservationJson, write_observation
from osfcore.io.scene_file import EstimateJson, read_estimated, read_scene, state_to_json, write_estimated
from osfcore.objects.asset_library import AssetLibrary
from osfcore.paper.method import Method

from ..jobs.job import Job, JobPage
from ..jobs.kinds.estimates import (
    OBSERVATION,
    PRIOR,
    STATE,
    STEPS,
    TRUTH,
    EstimateParams,
    Mode,
    Source,
    check_method,
    read_steps,
    state_of_step,
)
from ..processes.messages.neural_messages import CompareView
from ..storage.uploads import Examiner, save
from .fields import FieldCatalogue
from .runner import Runner
from .scenes import scene_or_current

KIND = "estimate"


class NoScene(OsfError):
    """There is nothing to look at."""

    def __init__(self) -> None:
        super().__init__("There is no scene to estimate; make one, or upload an observation.")


class NoPrior(OsfError):
    """An estimate that needs an earlier one."""

    def __init__(self, mode: str, where: str) -> None:
        super().__init__(f'Mode "{mode}" begins with an earlier estimate, and there is none {where}.')


class NoImages(OsfError):
    """An estimate whose images are gone, or not there yet."""

    def __init__(self, why: str) -> None:
        super().__init__(f"This estimate has no images to show; {why}.")


@dataclass(frozen=True, slots=True)
class Asked:
    """What to estimate, and how.

    Attributes:
        mode: "first" with masks, "next" from an earlier estimate, "goal" for one view without masks.
        seed: of the searches.
        prior: the earlier estimate; None for the latest one of the same scene.
    """

    mode: Mode = "first"
    seed: int = 0
    prior: str | None = None
    method: Method = "ours"

    def check(self) -> None:
        """Refuse what cannot be.

        Raises:
            InvalidInput: if the seed is out of range, or a method cannot do the mode.
        """
        check_seed(self.seed)
        check_method(self.mode, self.method)


class Estimates:
    """The estimates of one service. Methods that change something block; any thread may call them.

    Args:
        runner: holds scenes and jobs.
        fields: what can be recognised.
    """

    def __init__(self, runner: Runner, fields: FieldCatalogue) -> None:
        self._runner = runner
        self._fields = fields
        self._examiner: Examiner[Uploaded] = Examiner(examine, "observation", names_for_people, ARCHIVE)

    def stop(self) -> None:
        """End the process that looks at an upload, if there is one. Calling it again does nothing."""
        self._examiner.stop()

    # Asking for one

    def of_scene(self, asked: Asked, scene: str | None = None) -> Job:
        """Look at a scene, the current one if none is named, and estimate what is seen.

        Raises:
            NoScene, UnknownName: if there is no such scene.
            MissingFields, NoPublishedField: if an object in it cannot be recognised.
            NoPrior: if an earlier estimate is needed and there is none.
            QueueFull: if too many jobs wait.
        """
        asked.check()
        table = scene_or_current(self._runner.scenes, scene, NoScene)
        scene, names = table.id, table.state.names
        self._fields.require(names, asked.method)
        prior = None if asked.mode == "first" else self._prior(asked, names, scene)
        with self._runner.jobs.new_inputs() as folder:
            seen = self._runner.scenes.observe(scene, goal=asked.mode == "goal", masks=asked.mode == "first")
            write_observation(folder / OBSERVATION, seen.observation)
            write_json(folder / TRUTH, state_to_json(seen.record.state))
            if prior is not None:
                write_estimated(folder / PRIOR, prior)
            of = Source(scene=scene, revision=seen.record.revision)
            return self._submit(asked, of, names, tuple(camera.name for camera in seen.observation.cameras), folder)

    async def of_upload(self, asked: Asked, chunks: AsyncIterator[bytes], file_name: str) -> Job:
        """Take in a zipped observation folder, and estimate what it shows.

        Args:
            asked: what to estimate, and how.
            chunks: the archive, bit by bit.
            file_name: what the uploader calls it, for people.

        Raises:
            UploadRefused, CannotStore: if it cannot be read, or the disk is full.
            InvalidInput: if it does not fit the mode.
            UnknownName: if an object in it cannot be recognised, or the earlier estimate is unknown.
            NoPrior: if an earlier estimate is needed and there is none.
            QueueFull, StorageFull: if too many jobs wait, or nothing more may be written.
        """
        asked.check()
        await run_in_threadpool(self._runner.storage.check_room)
        with self._runner.jobs.new_inputs() as folder:
            await save(chunks, folder / ARCHIVE)
            uploaded = await self._examiner.examine(folder)
            return await run_in_threadpool(self._of_examined, asked, uploaded, folder, file_name)

    def _of_examined(self, asked: Asked, uploaded: Uploaded, folder: Path, file_name: str) -> Job:
        """Queue an estimate of an upload; what the estimator would refuse is refused at once."""
        check_known("field", uploaded.names, self._fields.names())
        self._fields.require(uploaded.names, asked.method)
        if asked.mode == "first" and not uploaded.has_masks:
            raise InvalidInput("masks of the first frame", "missing", "given: one per camera and object")
        if asked.mode == "first" and uploaded.unseen:
            raise InvalidInput(f"mask of {uploaded.unseen[0]}", "empty in every view", "not empty in at least one view")
        if asked.mode == "goal" and len(uploaded.cameras) != 1:
            raise InvalidInput("number of views of a goal", len(uploaded.cameras), "1")
        if asked.mode != "first" and not (uploaded.has_prior and asked.prior is None):
            write_estimated(folder / PRIOR, self._prior(asked, uploaded.names, None))
        of = Source(scene=None, file_name=file_name)
        return self._submit(asked, of, uploaded.names, uploaded.cameras, folder)

    def _submit(self, asked: Asked, of: Source, names: tuple[str, ...], cameras: tuple[str, ...], folder: Path) -> Job:
        params = EstimateParams(
            mode=asked.mode, method=asked.method, seed=asked.seed, of=of, names=names, cameras=cameras
        )
        return self._runner.submit_with_inputs(KIND, params, folder)

    def _prior(self, asked: Asked, names: tuple[str, ...], scene: str | None) -> EstimatedState:
        """The estimate to begin with, of the same objects, in whatever order."""
        if asked.prior is not None:
            job = self.get(asked.prior)
            if job.state != "done":
                raise InvalidInput("status of the estimate to begin with", job.state, "done")
        elif scene is None:
            raise NoPrior(asked.mode, "in the archive (prior.json) or named in the request (prior)")
        else:
            done = ((job, EstimateParams.from_json(job.params)) for job in self.all() if job.state == "done")
            job = next((job for job, params in done if params.of.scene == scene and params.mode != "goal"), None)
            if job is None:
                raise NoPrior(asked.mode, "of this scene")
        prior = self._state(job)
        if set(prior.state.names) != set(names):
            raise InvalidInput(
                "list of objects of the estimate to begin with", ", ".join(prior.state.names), ", ".join(names)
            )
        return prior

    # Telling of one

    def all(self) -> tuple[Job, ...]:
        """All estimates, newest first."""
        return tuple(job for job in self._runner.jobs.all() if job.kind == KIND)

    def page(self, limit: int, before: int | None = None) -> JobPage:
        """Some of the estimates, newest first, see `JobTable.page`."""
        return self._runner.jobs.page(limit, before, KIND)

    def get(self, estimate: str) -> Job:
        """One estimate.

        Raises:
            UnknownName: if there is none of this name.
        """
        return self._runner.jobs.get(estimate, KIND)

    def steps(self, job: Job) -> tuple[dict[str, Any], ...]:
        """What was reported of each step so far, see `read_steps`."""
        return read_steps(self._runner.jobs.folder(job.id) / STEPS)

    def result(self, job: Job) -> EstimateJson | None:
        """What state.json holds; None until it is there."""
        return EstimateJson.of_estimate(self._state(job)) if job.state == "done" else None

    def simulation_errors(self, job: Job) -> dict[str, Any] | None:
        """How far the result is from the truth, which only a simulation knows; None without either."""
        truth = self._runner.jobs.inputs(job.id) / TRUTH
        if job.state != "done" or not truth.is_file():
            return None
        return errors_of(self._state(job).state, read_scene(truth).state, self._runner.library)

    def observed(self, job: Job, view: int) -> Path:
        """The image of a camera, by number.

        Raises:
            UnknownName: if there is no such camera.
            NoImages: if the estimate was cancelled or failed.
        """
        return self._observed(job, view)[1]

    def comparison(self, job: Job, view: int, step: int | None = None) -> CompareView:
        """The order that compares what a camera saw with a step's guess.

        Args:
            job: the estimate.
            view: number of the camera, from 0.
            step: number of the step, from 1; None for the latest one.

        Raises:
            UnknownName: if there is no such camera or step.
            NoImages: if the estimate was cancelled, failed or has not begun.
        """
        camera, image = self._observed(job, view)
        steps = self.steps(job)
        if not steps:
            raise NoImages("its first step has not been made yet")
        if step is not None and not 1 <= step <= len(steps):
            raise UnknownName("step", str(step), [f"1 to {len(steps)}"])
        state = state_of_step(steps[-1 if step is None else step - 1])
        try:
            return CompareView(uuid.uuid4().hex, state, camera, image.read_bytes())
        except FileNotFoundError:
            raise NoImages("they have been removed from the data directory") from None

    def _observed(self, job: Job, view: int) -> tuple[Camera, Path]:
        names = EstimateParams.from_json(job.params).cameras
        if not 0 <= view < len(names):
            raise UnknownName("view", str(view), [str(number) for number in range(len(names))])
        folder = self._runner.jobs.inputs(job.id) / OBSERVATION
        if not folder.is_dir():
            raise NoImages(f"it was {job.state}" if job.state == "cancelled" else f"it has {job.state}")
        file = folder / OBSERVATION_FILE
        observation = read_json(file, lambda data: decode(ObservationJson, data, "observation"))
        return observation.cameras[view].camera(), folder / observation.images[names[view]]

    def _state(self, job: Job) -> EstimatedState:
        return read_estimated(self._runner.jobs.folder(job.id) / STATE)


def errors_of(estimate: SceneState, truth: SceneState, library: AssetLibrary) -> dict[str, Any]:
    """Distances of positions [mm], angles between orientations that look different [deg], and of the light [deg].

    Args:
        estimate: the estimate.
        truth: of the same objects.
        library: knows which rotations of an object look alike.
    """
    from osfcore.metrics.pose_errors import rotation_error

    objects = []
    for name in estimate.names:
        ours, true = estimate.pose(name), truth.pose(name)
        turn = rotation_error(library.info(name).symmetry, ours.quaternion, true.quaternion)
        shift_mm = 1000 * float(np.linalg.norm(ours.position - true.position))
        objects.append({"name": name, "position_mm": shift_mm, "rotation_deg": float(np.rad2deg(turn))})
    a, b = estimate.light.direction, truth.light.direction
    light = float(np.rad2deg(np.arctan2(np.linalg.norm(np.cross(a, b)), a @ b)))
    return {"objects": objects, "light_deg": light}


# Zipped observation folders that people upload for estimates: unpacked, judged, and refused at once if need be


ARCHIVE = "observation.zip"


@dataclass(frozen=True, slots=True)
class Uploaded:
    """What was found in an uploaded observation.

    Attributes:
        names: of the objects.
        cameras: their names.
        has_masks: whether it has visible pixels.
        unseen: objects whose masks are all empty.
        has_prior: whether a state of how the objects lie came with it.
    """

    names: tuple[str, ...]
    cameras: tuple[str, ...]
    has_masks: bool
    unseen: tuple[str, ...]
    has_prior: bool


def examine(folder: Path) -> Uploaded:
    """Unpack `observation.zip` of a folder to `observation` beside it and judge it, as `osf check` does.

    Raises:
        OsfError: if it is no sound observation.
    """
    from osfcore.io.archives import unpack_observation
    from osfcore.io.observation_file import read_observation

    place = unpack_observation(folder / ARCHIVE, folder / OBSERVATION)
    (folder / ARCHIVE).unlink()
    observation = read_observation(place)
    names, masks = observation.names, observation.masks
    unseen = () if masks is None else tuple(name for i, name in enumerate(names) if not masks[:, i].any())
    has_prior = (place / PRIOR).is_file()
    if has_prior:
        prior = read_estimated(place / PRIOR)
        if set(prior.state.names) != set(names):
            raise InvalidInput("objects of prior.json", ", ".join(prior.state.names), ", ".join(names))
        with writing(folder):
            (place / PRIOR).rename(folder / PRIOR)
    cameras = tuple(camera.name for camera in observation.cameras)
    return Uploaded(names, cameras, masks is not None, unseen, has_prior)


def names_for_people(folder: Path) -> dict[str, str]:
    """What the uploader calls the places in a folder."""
    return {
        f"{folder / ARCHIVE}": "The uploaded file",
        f"{folder / OBSERVATION}/": "",
        f"{folder / OBSERVATION}": "The uploaded observation",
    }
