"""The job that runs an episode on a scene of the service.

Its parameters name the scene, which it drives while it runs: hands may move things while it pauses. A goal image lies
in its inputs as `goal.png`; goal poses stand in the parameters. Where everything truly is in the image, if that is
known, is for the report alone. It leaves what `osf episode` leaves. The method as published wants a goal image.
"""

from __future__ import annotations

import contextlib
from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from jaxtyping import Float
from pydantic import model_validator

from osfcore.control.events import EpisodeSettings, Event, Looking, Observed, Planning, Stepped
from osfcore.control.world import World
from osfcore.errors import OsfError
from osfcore.fields.field_library import FieldLibrary
from osfcore.geometry.cameras import Camera
from osfcore.geometry.poses import Pose, rotation_angle
from osfcore.geometry.states import Observation, SceneState
from osfcore.geometry.workspace import check_action
from osfcore.io.files import read_json
from osfcore.io.scene_file import CameraJson, ObjectJson
from osfcore.paper.method import Method
from osfcore.paper.mppi import GaussianPlanSettings
from osfcore.planning.costs import PoseGoal
from osfcore.planning.mppi import PlanSketch, sketch_of
from osfcore.random_streams import Stream, stream_rng
from osfcore.world.simulators import Simulator

from ...episodes.file_names import GOAL_FILE, PREPARED_FILE, RECORDING_FILE
from ...episodes.progress import EpisodeProgress, TimeLeft
from ...episodes.settings import ChosenSettings, StoredSettings
from ...processes.messages.scene_messages import Act, JobCommand, ObservedScene, ObserveScene, SceneRecord, TakeView
from ..job import INPUTS
from ..kind import JobKind
from ..params import JobParams

if TYPE_CHECKING:
    from osfcore.control.estimators import SceneModels
    from osfcore.control.goal import GoalImage

    from ..context import JobContext

_STAYS_M, _STAYS_RAD = 0.005, 0.1  # an object this close to its goal did not have to move


@dataclass(frozen=True, eq=False, slots=True)
class EpisodeJobProgress(EpisodeProgress):
    """How far an episode is; nothing of how long acting takes is known before it begins.

    Attributes:
        share: of the episode that is over, from 0 to 1.
        left_s: time left, estimated [s]; None before it begins.
        steps: rounds whose results are in the report.
        seconds: spent so far, without pauses [s]; None before the first look.
        view: what just happened, as a picture shows it.
    """

    share: float = 0.0
    left_s: float | None = None
    steps: int = 0
    seconds: float | None = None
    view: Event | PlanSketch | None = None

    @property
    def ends_round(self) -> bool:
        """Whether a round of the loop is over, so that a job that goes on by single steps rests now."""
        return isinstance(self.view, Stepped)

    @property
    def must_be_reported(self) -> bool:
        """Whether a view that misses this would show something wrong."""
        return self.view is not None and not isinstance(self.view, Looking)


class EpisodeGoal(JobParams):
    """Goal poses, or the camera that took the goal image.

    Attributes:
        id: of the goal; None if poses were given for this episode alone.
        camera: as in scene.json; None without an image.
        poses: where the objects shall be; None if that is to be read from the image.
        truth: where they are in the image, for the report alone; None where nobody knows.
    """

    id: str | None
    camera: CameraJson | None = None
    poses: tuple[ObjectJson, ...] | None = None
    truth: tuple[ObjectJson, ...] | None = None


class EpisodeParams(JobParams):
    """The scene that is driven, and how.

    Attributes:
        scene: its identifier.
        title: what the episode is called; None if it has no name.
        names: of the scene's objects.
        seed: of the searches.
        settings: at the beginning, or what they were changed to.
        goal: what the table shall look like.
        simulator: what moves the objects; None in records of earlier versions.
    """

    scene: str
    title: str | None = None
    names: tuple[str, ...]
    seed: int
    settings: StoredSettings
    goal: EpisodeGoal
    simulator: Simulator | None = None

    @model_validator(mode="before")
    @classmethod
    def _of_earlier_versions(cls, stored: dict[str, Any]) -> dict[str, Any]:
        if "method" not in stored or not isinstance(stored.get("settings"), dict):
            return stored
        return {**stored, "settings": {"method": stored["method"], **stored["settings"]}}


def episode_job(params: EpisodeParams, place: JobContext) -> Iterator[EpisodeJobProgress]:
    """Run an episode.

    Raises:
        OsfError: if an object has no field, the goal does not fit, the simulation is gone, or the disk refuses.
    """
    from osfcore.control.closed_loop import Episode
    from osfcore.control.goal import GoalImage
    from osfcore.control.prepared import prepared_from_json
    from osfcore.fields.devices import use_one_thread

    from ...episodes.look_pictures import LookPictures
    from ...episodes.record import About, EpisodeRecord, recorded
    from ...episodes.recording import write_recording

    assert place.orders is not None, "the job's process sets it"
    use_one_thread()
    names, settings, method = params.names, params.settings.of_loop(), params.settings.method
    yield EpisodeJobProgress(0, 0, "Loading fields, half a minute the first time")
    models = _models(method, names, place)
    world = RemoteWorld(place.orders.ask, params.scene)
    goal, start = params.goal, world.truth()
    target = None if goal.truth is None else SceneState(names, _poses(goal.truth, names), start.light, None)
    inputs, rng = place.folder / INPUTS, stream_rng(params.seed, Stream.EPISODE)
    wanted, known = _goal(goal, names, inputs), inputs / PREPARED_FILE
    prepared = read_json(known, prepared_from_json) if known.is_file() else None
    image = wanted if method == "paper" else None
    assert image is None or isinstance(image, GoalImage), "the service renders poses for it"
    about = About(
        names, params.seed, settings, target, _moved(start, target), models.symmetries, method, image,
        simulator=params.simulator,
    )  # fmt: skip
    record = EpisodeRecord(place.folder, world, about)
    if image is None:
        loop = Episode(world, models, wanted, settings, rng, prepared=prepared)
        events = loop.run()
    else:
        loop, events = None, _published(world, models, image, settings, rng)
    progress, timer = EpisodeJobProgress(0, 0, "Looking"), TimeLeft(finds_goal=image is None)
    pictures = LookPictures(models.appearance.together, wanted)
    with contextlib.closing(record):
        for event in recorded(events, record):
            for change in place.orders.changes():
                if loop is not None:  # those of the paper's algorithm are fixed
                    loop.settings = ChosenSettings.of_stored(change["settings"]).of_loop()
            share, left_s = timer.take(event, progress.total or settings.steps)
            progress = replace(
                progress.after(event), share=share, left_s=round(left_s, 1), seconds=record.seconds,
                steps=record.steps_written, view=_drawn(pictures.drawn(event)),
            )  # fmt: skip
            yield progress
            timer.go_on()  # not before a pause is over
    yield replace(progress, note="Writing video and recording", view=None)
    record.finish()
    write_recording(place.folder / RECORDING_FILE, place.library, record.states)
    world.close()
    yield replace(progress, note=progress.text or progress.note, view=None)


def _models(method: Method, names: tuple[str, ...], place: JobContext) -> SceneModels:
    from osfcore.control.estimators import load_scene_models

    fields = FieldLibrary(place.data_dir)
    models = load_scene_models(names, fields, place.library, place.data_dir)
    if method == "ours":
        return models
    from osfcore.paper.stages import STAGES, with_paper_stages

    return with_paper_stages(models, frozenset(STAGES), fields, place.data_dir)


def _published(
    world: World, models: SceneModels, goal: GoalImage, settings: EpisodeSettings, rng: np.random.Generator
) -> Iterator[Event]:
    """Algorithm 1 of the paper; of the settings, steps, samples, horizon and temperature count."""
    from osfcore.paper.algorithm import AlgorithmSettings, run_algorithm
    from osfcore.paper.stages import PaperEstimators

    plan = settings.plan
    drawn = GaussianPlanSettings(plan.samples, plan.horizon, temperature=plan.temperature)
    return run_algorithm(world, models, goal, AlgorithmSettings(settings.steps, drawn), PaperEstimators(), rng)


def _drawn(event: Event) -> Event | PlanSketch | None:
    """Return what a picture shows of an event."""
    match event:
        case Observed():  # its images are on the page already
            return None
        case Planning(number, round_):
            return sketch_of(number, round_)
        case _:
            return event


def _goal(given: EpisodeGoal, names: tuple[str, ...], inputs: Path) -> GoalImage | PoseGoal:
    """The goal image among the inputs, or the poses in the parameters, with a photograph of them if there is one."""
    from osfcore.control.goal import PhotoGoal

    from ...episodes.request import read_goal

    image = None if given.camera is None else read_goal(inputs / GOAL_FILE, given.camera.camera())
    if given.poses is None:
        assert image is not None, "the service gives one or the other"
        return image
    poses = _poses(given.poses, names)
    return PoseGoal(names, poses) if image is None else PhotoGoal(names, poses, image)


def _poses(entries: tuple[ObjectJson, ...], names: tuple[str, ...]) -> Pose:
    """Poses in the order of `names`."""
    by_name = {entry.name: entry.pose() for entry in entries}
    return Pose.stacked(by_name[name] for name in names)


def _moved(start: SceneState, target: SceneState | None) -> tuple[str, ...]:
    """Objects that lie elsewhere in the goal than at the beginning."""
    if target is None:
        return ()
    shift_m = np.linalg.norm(target.poses.position - start.poses.position, axis=1)
    turn_rad = np.asarray(rotation_angle(target.poses.quaternion, start.poses.quaternion))
    return tuple(
        n for n, m, rad in zip(start.names, shift_m, turn_rad, strict=True) if m > _STAYS_M or rad > _STAYS_RAD
    )


# The page's table as a world: what an episode in a job's process sees and does there


class RemoteWorld:
    """A scene of the service, by way of the process that simulates it.

    The service stands in between: it stores each push, and lets a job change no scene but its own.

    Args:
        ask: has something done with the scene, and waits for the answer.
        scene: identifier.
    """

    def __init__(self, ask: Callable[[JobCommand], Any], scene: str) -> None:
        self._ask, self._scene = ask, scene
        self.record: SceneRecord | None = None  # the truth of the last moment; for reports, not for estimates

    def reset(self, seed: int) -> Observation:
        """Refuse: the scene is the page's.

        Raises:
            OsfError: always.
        """
        del seed
        raise OsfError("A scene of the service is reset by whoever made it, not by an episode.")

    def observe(self, *, masks: bool = False) -> Observation:
        """Images of all cameras.

        Raises:
            ProcessUnavailable: if the simulation is not there now.
        """
        seen: ObservedScene = self._ask(ObserveScene(self._scene, goal=False, masks=masks))
        self.record = seen.record
        return seen.observation

    def act(self, action: Float[np.ndarray, "3"]) -> None:
        """Hold the pusher velocity (vx, vy, 0) [m/s] for 0.2 s.

        Raises:
            InvalidInput: if the action is outside its limits; the world is unchanged.
            ProcessUnavailable: if the simulation is not there now.
        """
        self.record = self._ask(Act(self._scene, (check_action(action),)))

    def close(self) -> None:
        """Do nothing: the scene is the page's."""

    def truth(self) -> SceneState:
        """Where everything truly was, at the last moment that was reported; for reports, never for the loop."""
        record = self.record or self._ask(Act(self._scene, ()))
        self.record = record
        return record.state

    def photo(self, camera: Camera) -> Float[np.ndarray, "h w 3"]:
        """What a camera would see now, the pusher included, at its size."""
        return self._ask(TakeView(self._scene, camera)).astype(np.float32) / 255


# The kind of job


EPISODE = JobKind(
    "episode", "episode", episode_job, EpisodeParams,
    preloads=("osfcore.world.tabletop", "osfcore.control.closed_loop", "osfcore.control.estimators"),
    uses_physics=True, keeps_steps=True,
)  # fmt: skip
