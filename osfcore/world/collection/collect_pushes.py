"""Episodes of random pushes for learning dynamics (paper, section 5.2: 1,000 trajectories of 50 steps)."""

from __future__ import annotations

import functools
import time
from collections.abc import Iterator
from concurrent.futures import FIRST_COMPLETED, Executor, Future, wait
from concurrent.futures.process import BrokenProcessPool
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Literal

import numpy as np

from osfcore.errors import CannotWrite, InvalidInput, WorkerDied
from osfcore.geometry.cameras import DEFAULT_IMAGE_SIDE, default_cameras, goal_camera, image_side
from osfcore.geometry.light import MIN_LIGHT_ELEVATION_DEG, Light
from osfcore.geometry.poses import rotation_angle
from osfcore.geometry.states import MAX_OBJECTS, SceneState
from osfcore.io.image_file import to_uint8
from osfcore.io.push_file import EpisodeFolder, PushEpisode, load_episode, save_episode
from osfcore.objects.asset_library import AssetLibrary
from osfcore.random_streams import Stream, stream_rng, stream_seed
from osfcore.world.collection.disturbed_states import disturbed
from osfcore.world.collection.policies import DirectedPolicy, PaperPolicy, PolicyName
from osfcore.world.scene_request import SceneRequest
from osfcore.world.tabletop import Renderer, Tabletop

MOVED_M = 1e-3
MOVED_RAD = np.deg2rad(0.5)
SUBSTATES = 4  # poses recorded within an action: dynamics learns from them what contact does in between
FrameCamera = Literal["0", "goal"]
_MAX_EPISODES, _MAX_STEPS, _MAX_DISTURB = 1_000_000, 1000, 100


@dataclass(frozen=True, slots=True)
class CollectPushes:
    """What to collect.

    Attributes:
        out: the HDF5 file to write; must not exist.
        episodes: number of episodes.
        steps: actions of 0.2 s per episode.
        objects: objects per scene, chosen at random among those fetched.
        policy: "paper" (uniform random velocities) or "directed" (seeks sustained contact).
        seed: of everything.
        images: whether to keep frames of one camera as well, with the pusher.
        renderer: what takes the frames.
        names: objects to choose from; all of the library if None.
        disturb: from how many disturbed states to simulate each substep in which something moves (see
            `osfcore.world.collection.disturbed_states`).
        camera: that takes the frames.
        size: side of the frames [px].
        random_lights: frames under one light per episode from the whole hemisphere down to the lowest light that is
            allowed, instead of the scene's own; nothing else changes.
    """

    out: Path
    episodes: int = 1000
    steps: int = 50
    objects: int = 3
    policy: PolicyName = "paper"
    seed: int = 0
    images: bool = False
    renderer: Renderer = "embree"
    names: tuple[str, ...] | None = None
    disturb: int = 0
    camera: FrameCamera = "0"
    size: int = DEFAULT_IMAGE_SIDE
    random_lights: bool = False


@dataclass(frozen=True, slots=True)
class CollectStep:
    """Progress of a collection.

    Attributes:
        done: finished episodes, those of an earlier run included.
        total: episodes wanted.
        note: for a person.
        contact_share: share of finished steps in which the pusher touched something.
        motion_share: share of finished steps in which an object moved by 1 mm or 0.5 deg.
        episodes_per_s: in this run [1/s].
    """

    done: int
    total: int
    note: str
    contact_share: float
    motion_share: float
    episodes_per_s: float


def collect_pushes(
    config: CollectPushes, library: AssetLibrary, executor: Executor | None = None, in_flight: int = 8
) -> Iterator[CollectStep]:
    """Collect episodes; what was finished before a kill is kept and neither lost nor repeated.

    The content depends on the settings, not on the executor. An abandoned generator leaves its finished episodes in
    `OUT.partial`, from which the next run goes on.

    Args:
        config: what to collect.
        library: the objects.
        executor: simulates episodes side by side, if given; processes serve.
        in_flight: episodes handed to the executor at once: more than it has workers, but few, so that cancelling is
            quick.

    Raises:
        InvalidInput: if a number is out of range, the file exists, or the partial folder has other settings.
        OsfError: if there are too few objects.
    """
    _check(config)
    Tabletop(
        library, request=SceneRequest(count=config.objects, among=config.names)
    ).close()  # refuses before anything is written
    settings = {
        "steps": config.steps,
        "objects": config.objects,
        "policy": config.policy,
        "seed": config.seed,
        "images": config.images,
        "renderer": config.renderer,
        "available": list(library.names() if config.names is None else config.names),
        "disturb": config.disturb,
    }
    if config.images:
        settings |= {"camera": config.camera, "size": config.size, "random_lights": config.random_lights}
    try:
        config.out.parent.mkdir(parents=True, exist_ok=True)
        with EpisodeFolder(config.out, settings) as folder:
            yield from _collect(config, library.root, folder, executor, in_flight)
    except BrokenProcessPool as error:
        raise WorkerDied("collecting pushes") from error
    except OSError as error:
        raise CannotWrite(config.out, error.strerror or str(error)) from error


def _collect(
    config: CollectPushes, root: Path, folder: EpisodeFolder, executor: Executor | None, in_flight: int
) -> Iterator[CollectStep]:
    """Count what is there, run what is missing, put everything into one file."""
    tally = _Tally(config)
    done = folder.finished()
    for index in sorted(i for i in done if i < config.episodes):
        tally.add(load_episode(folder.path(index)))
    yield tally.step()
    missing = (i for i in range(config.episodes) if i not in done)
    for episode in _episodes(config, root, folder, missing, executor, in_flight):
        tally.add(episode, is_new=True)
        yield tally.step()
    folder.combine(config.episodes)


def _check(config: CollectPushes) -> None:
    if not 1 <= config.episodes <= _MAX_EPISODES:
        raise InvalidInput("number of episodes", config.episodes, f"between 1 and {_MAX_EPISODES}")
    if not 1 <= config.steps <= _MAX_STEPS:
        raise InvalidInput("number of steps", config.steps, f"between 1 and {_MAX_STEPS}")
    if not 1 <= config.objects <= MAX_OBJECTS:
        raise InvalidInput("number of objects", config.objects, f"between 1 and {MAX_OBJECTS}")
    if config.policy not in ("paper", "directed"):
        raise InvalidInput("policy", repr(config.policy), '"paper" or "directed"')
    if not 0 <= config.disturb <= _MAX_DISTURB:
        raise InvalidInput("disturbed states of each substep", config.disturb, f"between 0 and {_MAX_DISTURB}")
    if config.seed < 0:
        raise InvalidInput("seed", config.seed, "0 or more")
    if config.camera not in ("0", "goal"):
        raise InvalidInput("camera", repr(config.camera), '"0" or "goal"')
    image_side(config.size)
    if config.out.exists():
        raise InvalidInput("output file", config.out, "new")


class _Tally:
    """Counts over finished episodes."""

    def __init__(self, config: CollectPushes) -> None:
        self._config = config
        self._start = time.monotonic()
        self._done = self._new = self._contact = self._motion = 0

    def add(self, episode: PushEpisode, *, is_new: bool = False) -> None:
        self._done += 1
        self._new += is_new
        self._contact += int(episode.contact.any(axis=1).sum())
        shift = np.linalg.norm(np.diff(episode.positions, axis=0), axis=-1)
        turn = rotation_angle(episode.quaternions[:-1], episode.quaternions[1:])
        self._motion += int(((shift > MOVED_M) | (turn > MOVED_RAD)).any(axis=1).sum())

    def step(self) -> CollectStep:
        steps = max(self._done * self._config.steps, 1)
        contact, motion = self._contact / steps, self._motion / steps
        rate = self._new / max(time.monotonic() - self._start, 1e-9)
        note = f"Episode {self._done} of {self._config.episodes}, {contact:.0%} of steps with contact"
        return CollectStep(self._done, self._config.episodes, note, contact, motion, rate)


def _episodes(
    config: CollectPushes,
    root: Path,
    folder: EpisodeFolder,
    missing: Iterator[int],
    executor: Executor | None,
    in_flight: int,
) -> Iterator[PushEpisode]:
    """Run the missing episodes, here or in the executor, a few at a time."""
    if executor is None:
        for index in missing:
            yield _kept(folder.path(index), _run_episode(config, root, index))
        return
    running: dict[Future[PushEpisode], int] = {}
    try:
        while True:
            for index in missing:
                running[executor.submit(_run_episode, config, root, index)] = index
                if len(running) >= in_flight:
                    break
            if not running:
                return
            finished, _ = wait(running, return_when=FIRST_COMPLETED)
            for future in finished:
                yield _kept(folder.path(running.pop(future)), future.result())
    finally:
        for future in running:
            future.cancel()


@functools.lru_cache(maxsize=2)
def _tabletop(
    root: Path, objects: int, names: tuple[str, ...] | None, renderer: Renderer, view: tuple[FrameCamera, int]
) -> Tabletop:
    """One simulator per process and setting: its meshes stay loaded from episode to episode."""
    request = SceneRequest(count=objects, among=names)
    name, size = view
    camera = goal_camera(size) if name == "goal" else default_cameras(size)[0]
    return Tabletop(AssetLibrary(root), cameras=(camera,), request=request, renderer=renderer)


def _kept(path: Path, episode: PushEpisode) -> PushEpisode:
    """Save an episode here: whoever simulated it may be on another machine."""
    save_episode(path, episode)
    return episode


def _run_episode(config: CollectPushes, root: Path, index: int) -> PushEpisode:
    """Simulate one episode, which depends on nothing but the settings and its index."""
    seed = stream_seed(config.seed, Stream.COLLECTED_SCENE, index)
    world = _tabletop(root, config.objects, config.names, config.renderer, (config.camera, config.size))
    world.arrange(seed)
    if config.random_lights:
        lights = stream_rng(config.seed, Stream.COLLECTED_LIGHT, index)
        world.set_light(Light.random(lights, MIN_LIGHT_ELEVATION_DEG))
    rng = stream_rng(config.seed, Stream.COLLECTED_POLICY, index)
    policy = PaperPolicy(rng) if config.policy == "paper" else DirectedPolicy(world.assets, rng)
    states, contacts, actions, within = [world.truth()], [], [], []
    frames = [_frame(world, config)]
    for _ in range(config.steps):
        actions.append(policy.action(states[-1]))
        touched, poses = world.act_recorded(actions[-1], SUBSTATES)
        within.append(poses)
        contacts.append([name in touched for name in world.names])
        states.append(world.truth())
        frames.append(_frame(world, config))
    episode = PushEpisode(
        names=world.names,
        seed=seed,
        positions=np.array([s.poses.position for s in states]),
        quaternions=np.array([s.poses.quaternion for s in states]),
        pusher=np.array([_pusher(s) for s in states]),
        actions=np.array(actions),
        contact=np.array(contacts, bool),
        sub_positions=np.array([poses.position for poses in within]),
        sub_quaternions=np.array([poses.quaternion for poses in within]),
        frames=np.concatenate(frames) if config.images else None,
    )
    if config.disturb:
        disturbance = stream_rng(config.seed, Stream.COLLECTED_DISTURBANCE, index)
        substeps = disturbed(episode, world.models, disturbance, config.disturb)
        episode = replace(episode, disturbed=substeps)
    return episode


def _pusher(state: SceneState) -> np.ndarray:
    assert state.pusher is not None
    return state.pusher


def _frame(world: Tabletop, config: CollectPushes) -> np.ndarray:
    """The camera's view as one 8-bit frame, or no frame."""
    if not config.images:
        return np.zeros((0, config.size, config.size, 3), np.uint8)
    return to_uint8(world.observe().images)
