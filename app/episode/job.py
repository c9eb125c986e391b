"""The job that runs an episode on a scene of the service.

Its parameters name the scene, which it drives while it runs: hands may move things while it pauses. A goal image lies
in its inputs as `goal.png`; goal poses stand in the parameters. It leaves what `osf episode` leaves.
"""

from __future__ import annotations

import time
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from app.job import INPUTS

if TYPE_CHECKING:
    from app.job_process import Place
    from osfcore.control.events import Event
    from osfcore.control.settings import EpisodeSettings
    from osfcore.control.target import GoalImage
    from osfcore.plan.goals import PoseGoal

GOAL_FILE = "goal.png"  # among the inputs


@dataclass(frozen=True, eq=False, slots=True)
class Episoding:
    """How far an episode is.

    Attributes:
        done: actions executed.
        total: actions at most.
        note: what is being done, for a person.
        report: what came of it, without single steps; only at the end.
        seen: what just happened.
    """

    done: int
    total: int
    note: str
    report: dict[str, Any] | None = None
    seen: Event | None = None

    @property
    def ends_round(self) -> bool:
        """Whether a round of the loop is over, so that a job that goes on by single steps rests now."""
        from osfcore.control.events import Stepped

        return isinstance(self.seen, Stepped)


def episode_job(params: dict[str, Any], place: Place) -> Iterator[Episoding]:
    """Run an episode.

    Raises:
        OsfError: if an object has no field, the goal does not fit, the simulation is gone, or the disk refuses.
    """
    from app.episode.record import RECORDING_FILE, About, EpisodeRecord
    from app.episode.remote import RemoteWorld
    from app.episode.run import note_of
    from app.viewer.recording import write_recording
    from osfcore.control.episode import Episode
    from osfcore.control.events import Acted
    from osfcore.evaluate.mpc_runs import knowledge_of
    from osfcore.fields.library import FieldLibrary

    assert place.orders is not None, "the job's process sets it"
    settings, names = settings_of(params["settings"]), tuple(params["names"])
    yield Episoding(0, settings.steps, "Loading fields, half a minute the first time")
    knowledge = knowledge_of(names, FieldLibrary(place.data_dir), place.library, place.data_dir)
    world = RemoteWorld(place.orders.ask, params["scene"], place.folder)
    about = About(params["seed"], settings, None, (), knowledge.symmetries)
    record = EpisodeRecord(place.folder, world, about)
    rng = np.random.default_rng([params["seed"], 1])
    episode = Episode(world, knowledge, _goal(params["goal"], names, place.folder / INPUTS), settings, rng)
    began, done, note = time.perf_counter(), 0, ""
    for event in episode.run():
        for change in place.orders.changes():
            episode.settings = settings_of(change["settings"])
        record.take(event)
        done = event.number if isinstance(event, Acted) else done
        note = note_of(event) or note
        yield Episoding(done, episode.settings.steps, note, seen=event)
    report = record.finish(time.perf_counter() - began)
    write_recording(place.folder / RECORDING_FILE, place.library, record.states)
    world.close()
    told = {key: value for key, value in report.items() if key not in ("steps", "actions")}
    yield Episoding(done, episode.settings.steps, str(report["text"]), told)


def settings_of(given: Mapping[str, Any]) -> EpisodeSettings:
    """Settings from JSON; what is left out is as by default.

    Raises:
        InvalidInput: if a number is out of range.
    """
    from osfcore.control.settings import EpisodeSettings
    from osfcore.plan.mppi import PlanSettings

    own = {key: value for key, value in given.items() if key != "plan"}
    return EpisodeSettings(**own, plan=PlanSettings(**given.get("plan", {})))


def _goal(given: Mapping[str, Any], names: tuple[str, ...], inputs: Path) -> GoalImage | PoseGoal:
    """The goal image among the inputs, or the poses in the parameters."""
    from app.episode.order import read_goal
    from osfcore.plan.goals import PoseGoal
    from osfcore.poses import Pose
    from osfcore.scene import goal_camera

    if given.get("poses") is None:
        return read_goal(inputs / GOAL_FILE, goal_camera())
    poses = {entry["name"]: entry for entry in given["poses"]}
    positions, quaternions = (np.array([poses[n][part] for n in names], float) for part in ("position", "quaternion"))
    return PoseGoal(names, Pose(positions, quaternions))
