"""Recorded pushes of the simulated table, from directed and random policies, with disturbed starts."""

from __future__ import annotations

import functools
import time
from collections.abc import Iterator, Mapping
from concurrent.futures import FIRST_COMPLETED, Executor, Future, wait
from concurrent.futures.process import BrokenProcessPool
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Literal

import numpy as np
from jaxtyping import Float, Int

from osfcore.dynamics.motion import SLEEP_M, SLEEP_RAD, SUBSTEPS, is_on_table, pusher_path, substates
from osfcore.errors import InvalidInput, WorkerDied, check_ranges
from osfcore.geometry.cameras import DEFAULT_IMAGE_SIDE, default_cameras, goal_camera, image_side
from osfcore.geometry.light import MIN_LIGHT_ELEVATION_DEG, Light
from osfcore.geometry.poses import (
    Pose,
    quaternion_conjugate,
    quaternion_exp,
    quaternion_log,
    quaternion_multiply,
    rotate,
    rotation_angle,
)
from osfcore.geometry.states import MAX_OBJECTS, SceneState
from osfcore.geometry.workspace import MAX_SPEED_M_S, PUSHER_CENTRE_Z_M, PUSHER_RADIUS_M, STEP_S, WORKSPACE_HALF_M
from osfcore.io.files import writing
from osfcore.io.image_file import to_uint8
from osfcore.io.push_file import Disturbed, EpisodeFolder, PushEpisode, load_episode, save_episode
from osfcore.objects.asset import ObjectAsset
from osfcore.objects.asset_library import AssetLibrary
from osfcore.random_streams import Stream, stream_rng, stream_seed
from osfcore.world.physics import TIME_STEP_S, BodyModel, Physics
from osfcore.world.scenes import Conditions, Renderer, SceneRequest, check_request
from osfcore.world.simulators import Simulator, default_simulator, simulate
from osfcore.world.tabletop import Tabletop

# Substeps from disturbed states.
#
# Recorded motion holds only states that physics reaches. A network that predicts many steps in a row reaches others:
# an object too fast, turning too slowly, a little off the pusher. The simulator plays the next substep from recorded
# states that are disturbed in that way, so that a network learns to return to physical states.

_SUBSTEP_S = STEP_S / SUBSTEPS
_TICKS = round(_SUBSTEP_S / TIME_STEP_S)
_MOST = 0.5  # largest sigma of a disturbed velocity, as a share of its size and the following together
_SPEED_M, _SPEED_RAD = 0.002, 0.04  # in a substep
_ALONG = np.array([1, 1, 0.3])  # factors on x, y, z: less upward, for objects stay on the table
_ABOUT = np.array([0.5, 0.5, 1])  # factors on the angular velocity
_OFF_M, _OFF_RAD = 5e-4, 0.01  # largest sigma of a disturbed pose
_OFF_SHARE = 0.6  # of the objects, whose pose is disturbed as well


def disturbed(
    episode: PushEpisode,
    models: Mapping[str, BodyModel],
    rng: np.random.Generator,
    count: int,
    simulator: Simulator | None = None,
) -> Disturbed:
    """Simulate substeps from disturbed states of an episode, `count` for each substep in which something moves.

    Args:
        episode: recorded with poses within its actions.
        models: models of its objects.
        rng: draws the disturbances.
        count: number of disturbances of each such state.
        simulator: what simulates; PyBullet where it is installed if None.

    Raises:
        InvalidInput: if the episode was recorded without poses within its actions.
    """
    track = _Track(episode, models)
    physics = simulate({name: models[name] for name in episode.names}, simulator or default_simulator())
    try:
        parts = [track.disturb(physics, int(step), rng) for step in np.repeat(track.busy, count)]
    finally:
        physics.close()
    n = len(episode.names)
    shapes = ((), (n, 3), (n, 4), (n, 3), (n, 3), (n, 3), (n, 4))
    columns = list(zip(*parts, strict=True)) or [()] * len(shapes)
    stacked = [np.array(column).reshape(len(parts), *shape) for column, shape in zip(columns, shapes, strict=True)]
    return Disturbed(stacked[0].astype(int), *(column.astype(np.float32) for column in stacked[1:]))


class _Track:
    """An episode substep by substep.

    Attributes:
        busy: substeps in which and before which something moves, with everything on the table.
    """

    def __init__(self, episode: PushEpisode, models: Mapping[str, BodyModel]) -> None:
        self._names, self._actions = episode.names, episode.actions
        poses = substates(episode)
        self._positions, self._quaternions = poses.position, poses.quaternion
        self._offset = np.array([models[name].T_object_inertial.position for name in episode.names])
        centre = self._positions + rotate(self._quaternions, np.broadcast_to(self._offset, self._positions.shape))
        self._linear = np.diff(centre, axis=0)
        turned = quaternion_multiply(self._quaternions[1:], quaternion_conjugate(self._quaternions[:-1]))
        self._angular = quaternion_log(turned)
        self._path = pusher_path(episode.pusher[0, :2], episode.actions[:, :2])
        is_shifting = np.linalg.norm(self._linear, axis=-1) > SLEEP_M
        self._awake = is_shifting | (np.linalg.norm(self._angular, axis=-1) > SLEEP_RAD)
        on_table = is_on_table(episode)
        is_safe = np.repeat(on_table[:-1] & on_table[1:], SUBSTEPS)
        moves = np.any(self._awake, axis=1)
        self.busy: Int[np.ndarray, "S"] = 1 + np.flatnonzero(moves[1:] & moves[:-1] & is_safe[1:])

    def disturb(self, physics: Physics, step: int, rng: np.random.Generator) -> tuple[object, ...]:
        """Simulate one substep from a disturbed state; return the row of a `Disturbed`.

        Args:
            physics: a simulation of the episode's objects.
            step: number of the substep, at least 1: velocities are those of the one before.
            rng: draws the disturbance.
        """
        linear, angular = self._linear[step - 1], self._angular[step - 1]
        awake = self._awake[step - 1][:, None]
        share = _MOST * rng.random((len(awake), 1))
        linear = awake * (linear + _noise(linear, share, _SPEED_M, rng) * _ALONG)
        angular = awake * (angular + _noise(angular, share, _SPEED_RAD, rng) * _ABOUT)
        off = awake * rng.random((len(awake), 1)) * (rng.random((len(awake), 1)) < _OFF_SHARE)
        shift = np.pad(_OFF_M * off * rng.normal(size=(len(awake), 2)), ((0, 0), (0, 1)))
        turn = np.pad(_OFF_RAD * off * rng.normal(size=(len(awake), 1)), ((0, 0), (2, 0)))
        position = self._positions[step] + shift
        quaternion = quaternion_multiply(quaternion_exp(turn), self._quaternions[step])
        for i, name in enumerate(self._names):
            physics.place(name, Pose(position[i], quaternion[i]))
            physics.set_velocity(name, linear[i] / _SUBSTEP_S, angular[i] / _SUBSTEP_S)
        physics.place_pusher(np.array([*self._path[step], PUSHER_CENTRE_Z_M]))
        for _ in range(_TICKS):
            physics.step(self._actions[step // SUBSTEPS])
        after = Pose.stacked(physics.pose(name) for name in self._names)
        arm = -rotate(quaternion, self._offset)  # from the centre of mass to the object's origin
        origin = linear + np.cross(angular, arm)
        return step, position, quaternion, origin, angular, after.position, after.quaternion


def _noise(
    velocity: Float[np.ndarray, "N 3"], share: Float[np.ndarray, "N 1"], base: float, rng: np.random.Generator
) -> Float[np.ndarray, "N 3"]:
    """Draw noise whose sigma is a share of the velocity's size plus a base."""
    return share * (np.linalg.norm(velocity, axis=1, keepdims=True) + base) * rng.normal(size=velocity.shape)


# Policies of the pusher while data are collected: the paper's random walk, and one that seeks contact.


PolicyName = Literal["paper", "directed"]
_CLEARANCE_M = 0.02  # between pusher and object while travelling around it
_ARRIVED_M = 0.015
_TRAVEL_STEPS = 14  # then another object is tried
_NOISE_M_S = 0.03
_EDGE_M = 0.3


class PaperPolicy:
    """Each velocity component uniform in [-0.3, 0.3] m/s (paper, section 5.2)."""

    def __init__(self, rng: np.random.Generator) -> None:
        self._rng = rng

    def action(self, state: SceneState) -> Float[np.ndarray, "3"]:
        """Draw the next velocity (vx, vy, 0) [m/s]; the state is not used."""
        return np.array([*self._rng.uniform(-MAX_SPEED_M_S, MAX_SPEED_M_S, 2), 0.0])


class DirectedPolicy:
    """Goes behind a random object, pushes it some way toward a random place in the workspace, picks the next.

    Uses true poses: it makes data, it does not plan.

    Args:
        assets: shapes of the objects.
        rng: randomness.
    """

    def __init__(self, assets: Mapping[str, ObjectAsset], rng: np.random.Generator) -> None:
        self._parts = {name: np.concatenate(asset.parts) for name, asset in assets.items()}
        self._rng = rng
        self._target = ""
        self._direction = np.zeros(2)
        self._push_steps = 0
        self._travel_steps = 0
        self._speed = MAX_SPEED_M_S

    def action(self, state: SceneState) -> Float[np.ndarray, "3"]:
        """Choose the next velocity (vx, vy, 0) [m/s], each component at most 0.3 m/s.

        Raises:
            InvalidInput: if the state has no pusher.
        """
        if state.pusher is None:
            raise InvalidInput("pusher of the state", "missing", "there")
        pusher = state.pusher[:2]
        if self._push_steps == 0 and self._travel_steps == 0:
            self._choose(state)
        pose = state.pose(self._target)
        if self._travel_steps > 0:
            self._travel_steps -= 1
            way, arrived = self._way_behind(pusher, pose)
            if not arrived:
                if self._travel_steps == 0:
                    self._push_steps = 0  # it takes too long: choose anew
                return _limited(way / STEP_S)
            self._travel_steps = 0
        self._push_steps -= 1
        if np.abs(pose.position[:2]).max() > WORKSPACE_HALF_M or np.abs(state.poses.position[:, :2]).max() > _EDGE_M:
            self._push_steps = 0  # it leaves the workspace, or shoves another toward the table's edge: let it be
        aim = pose.position[:2] - pusher  # steer toward the object's middle, or it slips off sideways
        aim = 0.6 * self._direction + 0.4 * aim / max(np.linalg.norm(aim), 1e-6)
        return _limited(self._speed * aim + self._rng.normal(0, _NOISE_M_S, 2))

    def _choose(self, state: SceneState) -> None:
        """Choose a random object and a direction toward a random place in the workspace."""
        self._target = state.names[self._rng.integers(len(state.names))]
        place = self._rng.uniform(-WORKSPACE_HALF_M, WORKSPACE_HALF_M, 2)
        way = place - state.pose(self._target).position[:2]
        self._direction = way / max(np.linalg.norm(way), 1e-6)
        self._speed = self._rng.uniform(0.1, MAX_SPEED_M_S)
        self._push_steps = int(self._rng.integers(4, 11))
        self._travel_steps = _TRAVEL_STEPS

    def _way_behind(self, pusher: np.ndarray, pose: Pose) -> tuple[Float[np.ndarray, "2"], bool]:
        """Return the next displacement [m] on the way behind the object, around it if need be; and whether it is there.

        A pusher that is not yet behind the object follows a circle around it.
        """
        outline = rotate(pose.quaternion, self._parts[self._target])[:, :2]
        centre = pose.position[:2]
        standoff = float((outline @ -self._direction).max()) + PUSHER_RADIUS_M + _CLEARANCE_M
        behind = centre - self._direction * standoff
        way = behind - pusher
        if np.linalg.norm(way) < _ARRIVED_M:
            return way, True
        out = pusher - centre
        distance = max(float(np.linalg.norm(out)), 1e-6)
        if out @ -self._direction < 0.5 * distance:
            radius = np.linalg.norm(outline, axis=1).max() + PUSHER_RADIUS_M + _CLEARANCE_M
            tangent = np.array([-out[1], out[0]]) / distance
            tangent *= np.sign(tangent @ (behind - centre)) or 1.0
            way = tangent * MAX_SPEED_M_S * STEP_S + (radius - distance) * out / distance
        return way, False


def _limited(velocity: Float[np.ndarray, "2"]) -> Float[np.ndarray, "3"]:
    """Scale a velocity [m/s] into the speed limit without changing its direction."""
    velocity = velocity / max(np.abs(velocity).max() / MAX_SPEED_M_S, 1.0)
    return np.array([*np.clip(velocity, -MAX_SPEED_M_S, MAX_SPEED_M_S), 0.0])


# Episodes of random pushes for learning dynamics (paper, section 5.2: 1,000 trajectories of 50 steps).


MOVED_M = 1e-3
MOVED_RAD = np.deg2rad(0.5)
SUBSTATES = 4  # poses recorded within an action: dynamics learns from them what contact does in between
FrameCamera = Literal["0", "goal"]
_MAX_EPISODES, _MAX_STEPS, _MAX_DISTURB = 1_000_000, 1000, 100


@dataclass(frozen=True, slots=True)
class CollectPushes:
    """Settings of a collection.

    Attributes:
        out: the HDF5 file to write; must not exist.
        episodes: number of episodes.
        steps: actions of 0.2 s per episode.
        objects: objects per scene, chosen at random among those fetched.
        policy: "paper" (uniform random velocities) or "directed" (seeks sustained contact).
        seed: seed of everything.
        images: whether to keep frames of one camera as well, with the pusher.
        renderer: renderer of the frames.
        names: objects to choose from; all of the library if None.
        disturb: from how many disturbed states to simulate each substep in which something moves.
        camera: that takes the frames.
        size: side of the frames [px].
        random_lights: frames under one light per episode from the whole hemisphere down to the lowest light that is
            allowed, instead of the scene's own; nothing else changes.
        simulator: what moves the objects; PyBullet where it is installed if None.
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
    simulator: Simulator | None = None


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
    """Collect episodes; those that were finished before a kill are neither lost nor repeated.

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
    check_request(library, SceneRequest(count=config.objects, among=config.names))
    decisive = ("steps", "objects", "policy", "seed", "images", "renderer", "disturb")
    if config.images:
        decisive += ("camera", "size", "random_lights")
    settings = {name: getattr(config, name) for name in decisive}
    settings["available"] = list(library.names() if config.names is None else config.names)
    with writing(config.out):
        config.out.parent.mkdir(parents=True, exist_ok=True)
        with EpisodeFolder(config.out, settings) as folder:
            tally, done = _Tally(config), folder.finished()
            for index in sorted(i for i in done if i < config.episodes):
                tally.add(load_episode(folder.path(index)))
            yield tally.step()
            missing = (i for i in range(config.episodes) if i not in done)
            for index, episode in _simulate(config, library.root, missing, executor, in_flight):
                save_episode(folder.path(index), episode)
                tally.add(episode, is_new=True)
                yield tally.step()
            folder.combine(config.episodes)


def _check(config: CollectPushes) -> None:
    check_ranges(
        ("number of episodes", config.episodes, 1, _MAX_EPISODES),
        ("number of steps", config.steps, 1, _MAX_STEPS),
        ("number of objects", config.objects, 1, MAX_OBJECTS),
        ("disturbed states of each substep", config.disturb, 0, _MAX_DISTURB),
    )
    if config.policy not in ("paper", "directed"):
        raise InvalidInput("policy", repr(config.policy), '"paper" or "directed"')
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


def _simulate(
    config: CollectPushes, root: Path, missing: Iterator[int], executor: Executor | None, in_flight: int
) -> Iterator[tuple[int, PushEpisode]]:
    """Run the missing episodes, here or in the executor (maybe on other machines), a few at a time."""
    if executor is None:
        yield from ((index, _run_episode(config, root, index)) for index in missing)
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
                yield running.pop(future), future.result()
    except BrokenProcessPool as error:
        raise WorkerDied("collecting pushes") from error
    finally:
        for future in running:
            future.cancel()


@functools.lru_cache(maxsize=2)
def _tabletop(
    root: Path,
    objects: int,
    names: tuple[str, ...] | None,
    renderer: Renderer,
    simulator: Simulator,
    name: FrameCamera,
    size: int,
) -> Tabletop:
    """Make one simulator per process and setting: its meshes stay loaded from episode to episode."""
    request = SceneRequest(count=objects, among=names)
    camera = goal_camera(size) if name == "goal" else default_cameras(size)[0]
    conditions = Conditions(renderer=renderer, simulator=simulator)
    return Tabletop(AssetLibrary(root), cameras=(camera,), request=request, conditions=conditions)


def _run_episode(config: CollectPushes, root: Path, index: int) -> PushEpisode:
    """Simulate one episode, which depends on nothing but the settings and its index."""
    seed = stream_seed(config.seed, Stream.COLLECTED_SCENE, index)
    simulator = config.simulator or default_simulator()
    world = _tabletop(root, config.objects, config.names, config.renderer, simulator, config.camera, config.size)
    world.arrange(seed)
    if config.random_lights:
        lights = stream_rng(config.seed, Stream.COLLECTED_LIGHT, index)
        world.set_light(Light.random(lights, MIN_LIGHT_ELEVATION_DEG))
    rng = stream_rng(config.seed, Stream.COLLECTED_POLICY, index)
    policy = PaperPolicy(rng) if config.policy == "paper" else DirectedPolicy(world.assets, rng)
    states, contacts, actions, within = [world.truth()], [], [], []
    frames = [to_uint8(world.observe().images)] if config.images else []
    for _ in range(config.steps):
        actions.append(policy.action(states[-1]))
        touched, poses = world.act_recorded(actions[-1], SUBSTATES)
        within.append(poses)
        contacts.append([name in touched for name in world.names])
        states.append(world.truth())
        if config.images:
            frames.append(to_uint8(world.observe().images))
    episode = PushEpisode(
        names=world.names,
        seed=seed,
        positions=np.array([s.poses.position for s in states]),
        quaternions=np.array([s.poses.quaternion for s in states]),
        pusher=np.array([s.pusher for s in states]),
        actions=np.array(actions),
        contact=np.array(contacts, bool),
        sub_positions=np.array([poses.position for poses in within]),
        sub_quaternions=np.array([poses.quaternion for poses in within]),
        frames=np.concatenate(frames) if config.images else None,
    )
    if config.disturb:
        disturbance = stream_rng(config.seed, Stream.COLLECTED_DISTURBANCE, index)
        spread = disturbed(episode, world.models, disturbance, config.disturb, simulator)
        episode = replace(episode, disturbed=spread)
    return episode
