"""Episodes: asking for one, and telling what came of it. The work is a job (`app.jobs.kinds.episodes`)."""

from __future__ import annotations

import itertools
import shutil
from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from app.episodes.file_names import GOAL_FILE, PREPARED_FILE
from app.jobs.job import Job, JobPage
from app.jobs.kinds.episodes import method_of, settings_of
from app.processes.messages.scene_messages import ComposeGoal
from app.services.episode_results import EpisodeResults
from app.services.examples import Stories
from app.services.fields import FieldCatalogue
from app.services.goals import GOAL_SIDE, GoalChecks, Goals, NoTable
from app.services.runner import Runner
from app.storage.database import CannotStore
from app.storage.records import GoalRecord, Poses, poses_to_json
from osfcore.control.events import EpisodeSettings
from osfcore.errors import InvalidInput, OsfError, check_seed
from osfcore.geometry.cameras import goal_camera
from osfcore.geometry.poses import unit_quaternion
from osfcore.io.files import write_atomically
from osfcore.io.scene_file import camera_to_json
from osfcore.paper.method import Method
from osfcore.paper.mppi import STEPS, GaussianPlanSettings

KIND, CLIP_KIND = "episode", "clip"
_MOST_NAMES = 1000  # that a new one is compared with
_PLAN = ("samples", "horizon", "temperature")
_FIXED = {  # of the method as published: what it is called, and what it cannot but be
    "cost": ("cost", "image"),
    "replan_every": ("actions of each plan", 1),
    "planning": ("planning", True),
    "acting": ("acting", True),
}


class NoGoal(OsfError):
    """An episode needs exactly one goal."""

    def __init__(self) -> None:
        super().__init__("An episode needs a goal: name a goal image (goal), or give poses of all objects (poses).")


class EpisodeGoesOn(OsfError):
    """A clip of something that is not over."""

    def __init__(self) -> None:
        super().__init__("The episode goes on; a clip can be made when it is over.")


class GoalUnknown(OsfError):
    """A clip of an episode that looked at images alone."""

    def __init__(self) -> None:
        super().__init__(
            "A clip shows distances to the goal, which the method as published never knows; watch the video."
        )


@dataclass(frozen=True, eq=False, slots=True)
class AskedEpisode:
    """What to do.

    Attributes:
        scene: identifier; None for the current one.
        goal: identifier of a goal image; None where poses are given.
        poses: where all objects shall be; None where a goal image is named.
        seed: of the searches.
        settings: changes of the method's defaults, see `defaults`.
        method: whose; the one as published looks at the goal as an image alone.
    """

    scene: str | None = None
    goal: str | None = None
    poses: Poses | None = None
    seed: int = 0
    settings: Mapping[str, Any] = field(default_factory=dict)
    method: Method = "ours"


class Episodes(EpisodeResults):
    """The episodes of one service. Methods that change something block; any thread may call.

    Args:
        runner: holds scenes and jobs.
        fields: what can be recognised.
        goals: goal images.
        checks: of goal images.
    """

    def __init__(self, runner: Runner, fields: FieldCatalogue, goals: Goals, checks: GoalChecks) -> None:
        super().__init__(runner)
        self._fields = fields
        self._goals = goals
        self._checks = checks

    # Asking for one

    def start(self, asked: AskedEpisode) -> Job:
        """Queue an episode.

        Raises:
            NoTable, UnknownName: if there is no such scene or goal.
            NoGoal: if there is neither goal nor poses, or both.
            MissingFields, NoPublishedField: if an object cannot be recognised.
            GoalRefused: if the goal image does not show the scene's objects, unless doubts are not to matter.
            InvalidInput: if a setting is out of range, or the poses are not those of the scene's objects.
            QueueFull: if too many jobs wait.
            StorageFull: if nothing more may be written.
        """
        check_seed(asked.seed)
        scene = asked.scene or self._runner.scenes.current
        if scene is None:
            raise NoTable
        names = self._runner.scenes.get(scene).state.names
        self._fields.require(names, asked.method)
        settings = nested(asked.settings, asked.method)
        despite_doubts = settings_of(settings).despite_doubts
        if asked.goal is not None and asked.poses is None and not despite_doubts:
            self._checks.require(asked.goal, scene)
        with self._runner.jobs.new_inputs() as folder:
            params = {
                "scene": scene,
                "title": self._new_name(asked, names),
                "names": list(names),
                "seed": asked.seed,
                "method": asked.method,
                "settings": settings,
                "goal": self._goal(asked, scene, names, folder),
            }
            job = self._runner.submit_with_inputs(KIND, params, folder)
        self._goals.drop_draft()  # what is composed cannot be moved while the episode has the scene
        return job

    def change(self, job: Job, settings: Mapping[str, Any]) -> Job:
        """Let an episode go on with other settings.

        Raises:
            InvalidInput: if one is out of range, or another method, or the method as published, which goes as it began.
            WrongJobState: if the episode neither runs nor pauses.
        """
        own = method_of(job.params)
        if (method := settings.get("method", own)) != own:
            raise InvalidInput("method", method, f"{own}, as when the episode began")
        if own == "paper":
            raise InvalidInput("change of settings", "asked for", "left out: the method as published goes as it began")
        given = {key: value for key, value in settings.items() if key != "method"}
        merged = nested({**flat(self.settings(job)), **given})
        settings_of(merged)
        return self._runner.jobs.change(job.id, {"settings": merged})

    def _goal(self, asked: AskedEpisode, scene: str, names: tuple[str, ...], folder: Path) -> dict[str, Any]:
        """What the job is told of the goal; a goal image is copied for it."""
        if (asked.goal is None) == (asked.poses is None):
            raise NoGoal
        try:
            folder.mkdir(parents=True)
            if asked.goal is None:
                given = _of_all(asked.poses or (), names)
                if asked.method == "paper":
                    return self._rendered(given, scene, folder)
                poses = poses_to_json(given)
                return {"id": None, "camera": None, "poses": poses, "truth": poses}
            goal = self._goals.get(asked.goal)
            shutil.copyfile(self._goals.image(goal.id), folder / GOAL_FILE)
            prepared = None if goal.example is None or goal.scene != scene else Stories().prepared(goal.example)
            if prepared is not None:
                shutil.copyfile(prepared, folder / PREPARED_FILE)
        except OSError as error:
            raise CannotStore(folder, error.strerror or str(error)) from error
        if goal.source == "photo" and goal.poses is not None:
            return self._photographed(goal, goal.poses, asked, scene, names, folder)
        is_known = goal.poses is not None and goal.scene == scene and {name for name, _ in goal.poses} == set(names)
        truth = poses_to_json(goal.poses) if is_known and goal.poses is not None else None
        return {"id": goal.id, "camera": camera_to_json(goal.camera), "poses": None, "truth": truth}

    def _photographed(
        self, goal: GoalRecord, poses: Poses, asked: AskedEpisode, scene: str, names: tuple[str, ...], folder: Path
    ) -> dict[str, Any]:
        """A goal whose poses were found in a photograph: nothing is left to be read from its image."""
        given = _of_all(poses, names)
        if asked.method == "paper":
            return {**self._rendered(given, scene, folder), "id": goal.id}
        found = poses_to_json(given)
        return {"id": goal.id, "camera": camera_to_json(goal.camera), "poses": found, "truth": found}

    def _rendered(self, poses: Poses, scene: str, folder: Path) -> dict[str, Any]:
        """A goal that was given as poses, as the image that a method wants which knows of nothing else."""
        made = self._runner.scenes.compose(ComposeGoal(scene, poses, size=GOAL_SIDE))
        write_atomically(folder / GOAL_FILE, made.png)
        camera = camera_to_json(goal_camera(GOAL_SIDE))
        return {"id": None, "camera": camera, "poses": None, "truth": poses_to_json(made.poses)}

    def make_clip(self, job: Job) -> Job:
        """Queue the job that makes a clip of an episode; the one that is at it already, if there is one.

        Raises:
            NoTrajectory: if the episode cannot be drawn again.
            EpisodeGoesOn: if it is not over yet.
            GoalUnknown: if it never knew goal poses.
            QueueFull: if too many jobs wait.
            StorageFull: if nothing more may be written.
        """
        if not job.is_finished:
            raise EpisodeGoesOn
        if method_of(job.params) == "paper":
            raise GoalUnknown
        self.trajectory(job)
        for other in self._runner.jobs.live(CLIP_KIND):
            if other.params["episode"] == job.id:
                return other
        return self._runner.submit_job(CLIP_KIND, {"episode": job.id, "title": self.name(job)})

    # Telling of one

    def page(self, limit: int, before: int | None = None, search: str = "", outcome: str | None = None) -> JobPage:
        """Some of the episodes, newest first, see `JobTable.page`.

        Args:
            limit: how many at most.
            before: only older ones than this number.
            search: words that name or objects hold, all of them; capitals do not count.
            outcome: only those that ended so, or are in that state.
        """
        words = search.casefold().split()

        def fits(job: Job) -> bool:
            ended = (job.result or {}).get("outcome")
            if outcome not in (None, ended, job.state):
                return False
            labels = map(self._runner.library.label, job.params["names"]) if words else ()
            text = " ".join((self.name(job), *labels)).casefold()
            return all(word in text for word in words)

        return self._runner.jobs.page(limit, before, KIND, fits)

    def name(self, job: Job) -> str:
        """What people call an episode: its own name, or that of its objects in episodes of earlier versions."""
        return job.params.get("title") or ", ".join(map(self._runner.library.label, job.params["names"]))

    def rename(self, job: Job, name: str) -> Job:
        """Call an episode something else.

        Raises:
            InvalidInput: if the name is empty.
        """
        if not name.strip():
            raise InvalidInput("name", "empty", "some letters")
        return self._runner.jobs.rename(job.id, name.strip())

    def _new_name(self, asked: AskedEpisode, names: tuple[str, ...]) -> str:
        """That of the goal, or of the objects; with a number if there is one of that name already."""
        goal = None if asked.goal is None else self._goals.get(asked.goal)
        name = ", ".join(map(self._runner.library.label, names)) if goal is None else goal.name
        taken = {self.name(job) for job in self._runner.jobs.page(_MOST_NAMES, None, KIND).jobs}
        numbered = itertools.chain([name], (f"{name} {n}" for n in itertools.count(2)))
        return next(one for one in numbered if one not in taken)

    def get(self, episode: str) -> Job:
        """One episode.

        Raises:
            UnknownName: if there is none of this name.
        """
        return self._runner.jobs.get(episode, KIND)

    @staticmethod
    def settings(job: Job) -> EpisodeSettings:
        """How an episode goes now."""
        return settings_of(job.params["settings"])


def nested(settings: Mapping[str, Any], method: Method = "ours") -> dict[str, Any]:
    """Settings as a job has them, those of the plan by themselves; what is left out is as by default.

    Raises:
        InvalidInput: if one means something that the method does not have.
    """
    given = {**defaults(method), **settings}
    if method == "paper":
        for key, (what, only) in _FIXED.items():
            if given[key] != only:
                raise InvalidInput(what, given[key], f"{only} with the method as published")
    own = {key: value for key, value in given.items() if key not in _PLAN}
    return {**own, "plan": {key: given[key] for key in _PLAN}}


def defaults(method: Method) -> dict[str, Any]:
    """What settings are where nothing is said, as `flat` tells them."""
    if method == "ours":
        return flat(EpisodeSettings())
    plan = GaussianPlanSettings()
    own = {key: only for key, (_, only) in _FIXED.items()} | {key: getattr(plan, key) for key in _PLAN}
    return {**flat(EpisodeSettings(STEPS)), **own}


def flat(settings: EpisodeSettings) -> dict[str, Any]:
    """Settings as pages and programs have them: all in one place, without what nobody needs to change."""
    own = ("steps", "replan_every", "cost", "planning", "acting", "despite_doubts")
    return {name: getattr(settings, name) for name in own} | {name: getattr(settings.plan, name) for name in _PLAN}


def _of_all(poses: Poses, names: tuple[str, ...]) -> Poses:
    given = [name for name, _ in poses]
    if len(set(given)) != len(given) or set(given) != set(names):
        raise InvalidInput("objects of the goal", ", ".join(given) or "none", f"{', '.join(names)}, each once")
    for name, pose in poses:
        unit_quaternion(pose.quaternion, f"quaternion of {name}")
    return poses
