"""Rearrangement of a simulated tabletop as a Gymnasium environment, registered when this module is imported.

Each episode is a random rearrangement task (`osfcore.world.tasks`): a scene at rest, and its goal.

    import gymnasium
    import osfcore.contrib.tabletop_env
    env = gymnasium.make("OSFTabletop-v0")

or in one call `gymnasium.make("osfcore.contrib.tabletop_env:OSFTabletop-v0")`, which vectorised environments need in
their processes. Gymnasium has no entry points for packages since 1.0.

Raises:
    MissingExtra: on import, if Gymnasium is not installed.
"""

from __future__ import annotations

import contextlib
from dataclasses import replace
from pathlib import Path
from typing import Any, Literal, get_args

import numpy as np
from jaxtyping import Float, UInt8

from osfcore.errors import InvalidInput, NoRoom, OsfError, finite_vector
from osfcore.extras import need
from osfcore.geometry.cameras import Camera, default_cameras, goal_camera
from osfcore.geometry.states import pose_rows
from osfcore.geometry.workspace import MAX_SPEED_M_S, PUSHER_REACH_M, STEP_S, TABLE_SIDE_M, check_action
from osfcore.io.image_file import to_uint8
from osfcore.metrics.success import RearrangementScore, RearrangementTask, score_of
from osfcore.objects.asset_library import AssetLibrary
from osfcore.objects.data_dir import default_data_dir
from osfcore.world.scenes import Conditions, SceneRequest, check_request
from osfcore.world.simulators import Simulator, default_simulator
from osfcore.world.tabletop import Tabletop
from osfcore.world.tasks import Family, TaskSet, check_tasks, draw_task

need("gym", "The environment")
import gymnasium  # noqa: E402

TABLETOP_ID = "OSFTabletop-v0"
ACTIONS = 30  # of 0.2 s before an episode is truncated, as in evaluations of rearrangement

Kind = Literal["poses", "pixels", "both"]
KINDS: tuple[Kind, ...] = get_args(Kind)


_DRAWS = 10  # of a task, where objects do not fit
_SEEDS = 1 << 31
_TURNS = 3  # kinds of goals that take turns with a task's number
_SPEED = np.nextafter(np.float32(MAX_SPEED_M_S), np.float32(0))  # the largest of its precision within the limit
_FRAME_SIDE = 256


class TabletopEnv(gymnasium.Env[dict[str, Any], np.ndarray]):
    """A pusher must move some objects of a scene to their goals, and leave the others in place.

    The action is the pusher's velocity (vx, vy) [m/s], each within 0.3, held for 0.2 s. The observation is a dict:

        pusher   (2,) its position [m]
        objects  (N,) the number of each object among `objects_to_choose_from`    poses, both
        poses    (N, 7) position [m] and quaternion (w, x, y, z) with w >= 0, T_world_object    poses, both
        pixels   (V, h, w, 3) images of the four cameras, linear RGB, 8 bits    pixels, both
        goal     of the task: poses (N, 7), pixels (h, w, 3) from the goal camera without the pusher

    The reward of an action is the negative distance to the goal afterwards, as a mean over the N objects,

        r = -(1/N) sum_n sqrt(|p_n - p_n*|^2 + (2 sin(theta_n / 4))^2)

    with theta_n the angle to the nearest orientation that looks like the goal's: 2 sin(theta / 4) is the distance of
    unit quaternions, for the nearer sign (`ObjectScore.pose6d_symmetric`). An episode terminates when all objects are
    within 2 cm and 0.1 rad of their goals, including those that should not move. Gymnasium truncates it after 30
    actions, or `max_episode_steps` of `gymnasium.make`.

    `info` holds the objects' `names`, which had to move (`moved`), `success`, `moved_mm` and `moved_deg`, the mean
    errors of these, and `others_mm`, the largest of the others.

    Args:
        data_dir: data directory with `objects`; the default one if None.
        names: names of the objects to choose from; all available ones if None.
        objects: number of objects in each scene (N).
        family: family of the tasks: "shifted", "turned", "crowded", "relit" or "upright".
        obs: contents of observations: "poses", "pixels" or "both".
        image_side: side of observed images [px].
        render_mode: "rgb_array" or None.
        simulator: "pybullet" or "mujoco"; PyBullet where it is installed if None.

    Attributes:
        objects_to_choose_from: names of the objects by their numbers in observations.

    Raises:
        InvalidInput: if a choice is not one of these, or there are too few objects.
        MissingAssets: if the mesh of an object has not been fetched.
        UnknownName: if there is no such object.
    """

    metadata = {"render_modes": ["rgb_array"], "render_fps": round(1 / STEP_S)}  # noqa: RUF012  as Gymnasium has it

    def __init__(
        self,
        *,
        data_dir: str | Path | None = None,
        names: tuple[str, ...] | None = None,
        objects: int = 3,
        family: Family = "shifted",
        obs: Kind = "poses",
        image_side: int = 128,
        render_mode: str | None = None,
        simulator: Simulator | None = None,
    ) -> None:
        if obs not in KINDS:
            raise InvalidInput("kind of observations", repr(obs), f"one of {', '.join(KINDS)}")
        if render_mode not in (None, *self.metadata["render_modes"]):
            raise InvalidInput("render_mode", repr(render_mode), '"rgb_array" or left out')
        self._library = AssetLibrary((default_data_dir() if data_dir is None else Path(data_dir)) / "objects")
        check_request(self._library, SceneRequest(count=objects, among=names))
        self.objects_to_choose_from = self._library.names() if names is None else tuple(names)
        simulator = simulator or default_simulator()
        self._tasks = TaskSet(self.objects_to_choose_from, family, objects, simulator=simulator)
        check_tasks(self._tasks)
        self._kind: Kind = obs
        self.render_mode = render_mode
        self._cameras = default_cameras(image_side)
        self._goal_camera = goal_camera(image_side)
        self._symmetries = {name: self._library.info(name).symmetry for name in self.objects_to_choose_from}
        self.action_space = gymnasium.spaces.Box(-_SPEED, _SPEED, (2,), np.float32)
        self.observation_space = self._space(image_side)
        conditions = Conditions(simulator=simulator)
        self._world = Tabletop(self._library, cameras=self._cameras, conditions=conditions)
        self._task: RearrangementTask | None = None
        self._goal_image: UInt8[np.ndarray, "h w 3"] | None = None

    def reset(
        self, *, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[dict[str, Any], dict[str, Any]]:
        """Start a new task.

        Args:
            seed: seed of this task and all later ones; None to continue with the present seed.
            options: {"task_seed": s, "task_number": n} for task n of the set that evaluations use with seed s and the
                same objects; None for a random task.

        Raises:
            NoRoom: if no layout without overlaps was found.
            InvalidInput: if there are other options, or they are not whole numbers from 0 on.
        """
        super().reset(seed=seed)
        self._task = self._drawn() if not options else self._asked(options)
        if self._kind != "poses":
            self._world.restore(self._task.goal)
            self._goal_image = self._seen((self._goal_camera,), with_pusher=False)[0]
        self._world.restore(self._task.start)
        return self._observation(), self._info(self._score())

    def step(self, action: Float[np.ndarray, "2"]) -> tuple[dict[str, Any], float, bool, bool, dict[str, Any]]:
        """Hold a velocity for 0.2 s.

        Raises:
            InvalidInput: if the velocity is outside the action space. The table is then unchanged.
        """
        vx, vy = finite_vector(action, 2, "action (vx, vy) [m/s]")
        self._begun()
        self._world.act(check_action((vx, vy, 0.0)))
        score = self._score()
        return self._observation(), -score.pose6d_symmetric, score.is_tight(), False, self._info(score)

    def render(self) -> UInt8[np.ndarray, "h w 3"] | None:  # pyright: ignore[reportIncompatibleMethodOverride]
        """Return an image of the table from the goal camera, linear RGB with 8 bits."""
        if self.render_mode is None:
            return None
        self._begun()
        return self._seen((goal_camera(_FRAME_SIDE),))[0]

    def close(self) -> None:
        """Free the simulation."""
        self._world.close()

    def _drawn(self) -> RearrangementTask:
        """Draw a random task."""
        for _ in range(_DRAWS - 1):
            with contextlib.suppress(NoRoom):
                return self._numbered(int(self.np_random.integers(_SEEDS)), int(self.np_random.integers(_TURNS)))
        return self._numbered(int(self.np_random.integers(_SEEDS)), int(self.np_random.integers(_TURNS)))

    def _numbered(self, seed: int, number: int) -> RearrangementTask:
        return draw_task(self._library, replace(self._tasks, seed=seed), number).task

    def _asked(self, options: dict[str, Any]) -> RearrangementTask:
        """Draw the task that options name."""
        numbers = [options.get(key) for key in ("task_seed", "task_number")]
        if len(options) != len(numbers) or not all(isinstance(n, int) and 0 <= n < _SEEDS for n in numbers):
            raise InvalidInput("options", options, "{'task_seed': s, 'task_number': n}, whole numbers from 0 on")
        return self._numbered(options["task_seed"], options["task_number"])

    def _begun(self) -> RearrangementTask:
        if self._task is None:
            raise OsfError("The table is empty; reset the environment first.")
        return self._task

    def _score(self) -> RearrangementScore:
        return score_of(self._begun(), self._world.truth(), self._symmetries)

    def _seen(self, cameras: tuple[Camera, ...], *, with_pusher: bool = True) -> UInt8[np.ndarray, "V h w 3"]:
        return to_uint8(self._world.render(cameras, with_pusher=with_pusher).images)

    def _observation(self) -> dict[str, Any]:
        """Observe table and goal; no two observations share memory."""
        state, goal = self._world.truth(), self._begun().goal
        assert state.pusher is not None  # for the type checker: a simulated table has a pusher
        seen: dict[str, Any] = {"pusher": state.pusher[:2].clip(-PUSHER_REACH_M, PUSHER_REACH_M)}
        aim: dict[str, Any] = {}
        if self._kind != "pixels":
            seen["objects"] = np.array([self.objects_to_choose_from.index(name) for name in state.names])
            seen["poses"], aim["poses"] = pose_rows(state.poses), pose_rows(goal.poses)
        if self._goal_image is not None:
            seen["pixels"], aim["pixels"] = self._seen(self._cameras), self._goal_image.copy()
        return {**seen, "goal": aim}

    def _space(self, side: int) -> gymnasium.spaces.Dict:
        """Build the space of observations with images of a side [px]."""
        box = gymnasium.spaces.Box
        spaces: dict[str, gymnasium.Space[Any]] = {"pusher": box(-PUSHER_REACH_M, PUSHER_REACH_M, (2,), np.float64)}
        goal: dict[str, gymnasium.Space[Any]] = {}
        if self._kind != "pixels":
            spaces["objects"] = gymnasium.spaces.MultiDiscrete([len(self.objects_to_choose_from)] * self._tasks.objects)
            limits = np.tile([TABLE_SIDE_M] * 3 + [1.0] * 4, (self._tasks.objects, 1))
            spaces["poses"] = goal["poses"] = box(-limits, limits, dtype=np.float64)
        if self._kind != "poses":
            spaces["pixels"] = box(0, 255, (len(self._cameras), side, side, 3), np.uint8)
            goal["pixels"] = box(0, 255, (side, side, 3), np.uint8)
        return gymnasium.spaces.Dict({**spaces, "goal": gymnasium.spaces.Dict(goal)})

    def _info(self, score: RearrangementScore) -> dict[str, Any]:
        figures = {"moved_mm": score.moved_mm, "moved_deg": score.moved_deg, "others_mm": score.others_mm}
        names = {"names": list(self._begun().start.names), "moved": list(self._begun().moved)}
        return {**names, "success": score.is_tight(), **figures}


if TABLETOP_ID not in gymnasium.registry:
    gymnasium.register(TABLETOP_ID, entry_point=f"{__name__}:TabletopEnv", max_episode_steps=ACTIONS)
