"""The simulated tabletop: PyBullet or MuJoCo moves the objects, ray tracing (or TinyRenderer) takes the pictures.

It implements `osfcore.control.world.World`. It also returns the true state, renders any view and moves objects by hand.
One process can hold several. It is deterministic: the same seed gives exactly the same results.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping
from concurrent.futures import Executor
from dataclasses import dataclass, field, replace
from typing import TYPE_CHECKING

import numpy as np
from jaxtyping import Float

from osfcore.control.world import SimulatedWorld
from osfcore.errors import InvalidInput, OsfError, OverlappingObjects, check_known, finite_vector
from osfcore.geometry.cameras import Camera, default_cameras
from osfcore.geometry.light import Light
from osfcore.geometry.poses import Pose, unit_quaternion
from osfcore.geometry.states import Observation, SceneState
from osfcore.geometry.workspace import PUSHER_CENTRE_Z_M, PUSHER_REACH_M, check_action
from osfcore.objects.asset import ObjectAsset
from osfcore.objects.asset_library import AssetLibrary
from osfcore.plugins import PartKind
from osfcore.world.imaging import Picture, RayTracer, TracedMesh, masks_of
from osfcore.world.physics import SUBSTEPS, TIME_STEP_S, BodyModel, Physics, body_model
from osfcore.world.scenes import (
    Conditions,
    SceneRequest,
    check_place,
    check_request,
    is_calm,
    move_apart,
    place_randomly,
    refuse_overlaps,
)
from osfcore.world.simulators import Simulator, check_simulator, default_simulator, simulate

if TYPE_CHECKING:
    from osfcore.world.tiny_renderer import TinyScene

_SETTLE_LIMIT_S = 3.0


class Tabletop:
    """A simulated table with objects, a pusher, cameras and a light.

    Args:
        library: library of the objects' meshes.
        cameras: cameras that `observe` uses; `default_cameras()` if None.
        request: scene that `reset` arranges; three random objects if None.
        executor: pool of threads that renders several views at once; None to render one after the other.
        conditions: lamp, table, contacts and renderer; the usual ones if None.

    Attributes:
        cameras: cameras that `observe` uses.
        names: names of the objects on the table.

    Raises:
        UnknownName: if the library has no such object.
        MissingAssets: if the mesh of an object has not been fetched.
        InvalidInput: if there are too many objects, too few to choose from, or a name occurs twice.

    Example:
        >>> world = Tabletop(assets, request=SceneRequest(names=("006_mustard_bottle",)))
        >>> observation = world.reset(seed=0)
        >>> world.act(np.array([0.1, 0.0, 0.0]))  # 0.1 m/s along x for 0.2 s
        >>> bool((world.truth().pusher - observation.pusher)[0].round(3) == 0.02)
        True
        >>> world.close()
    """

    def __init__(
        self,
        library: AssetLibrary,
        *,
        cameras: tuple[Camera, ...] | None = None,
        request: SceneRequest | None = None,
        executor: Executor | None = None,
        conditions: Conditions | None = None,
    ) -> None:
        self.cameras = default_cameras() if cameras is None else cameras
        self._library = library
        self._request = SceneRequest() if request is None else request
        check_request(library, self._request)
        self._executor = executor
        self._conditions = conditions or Conditions()
        check_simulator(self._conditions.simulator)
        if self._conditions.renderer == "tiny":
            check_simulator("pybullet")
        self._assets: dict[str, ObjectAsset] = {}
        self._models: dict[str, BodyModel] = {}
        self._meshes: dict[str, TracedMesh] = {}
        self._physics: Physics | None = None
        self._tiny: TinyScene | None = None
        self.names: tuple[str, ...] = ()
        self._light = Light(np.array([0.0, 0.0, 1.0]))
        self._steps = 0

    # The World protocol

    def reset(self, seed: int) -> Observation:
        """Arrange a random scene at rest and observe it. The same seed, request and objects give the same scene.

        Raises:
            NoRoom: if the objects do not fit side by side.
        """
        self.arrange(seed)
        return self.observe()

    def observe(self, *, masks: bool = False) -> Observation:
        """Take an image with every camera; with `masks`, the visible pixels of each object as well."""
        return self.render(self.cameras, masks=masks)

    def act(self, action: Float[np.ndarray, "3"]) -> None:
        """Move the pusher with velocity (vx, vy, 0) in the world [m/s] for 0.2 s. It stops at the border of its reach.

        Raises:
            InvalidInput: if vx or vy exceeds 0.3 m/s in size, or vz is not 0. The world is then unchanged.
        """
        velocity = check_action(action)
        for _ in range(SUBSTEPS):
            self._advance(velocity)

    def close(self) -> None:
        """Release the simulation. Calling it again does nothing."""
        for simulation in (self._physics, self._tiny):
            if simulation is not None:
                simulation.close()
        self._physics = self._tiny = None

    # What only a simulator can do

    @property
    def assets(self) -> Mapping[str, ObjectAsset]:
        """The objects on the table with their meshes, by name."""
        return {name: self._asset(name) for name in self.names}

    @property
    def models(self) -> Mapping[str, BodyModel]:
        """Masses and collision shapes of the objects on the table, by name."""
        return {name: self._models[name] for name in self.names}

    @property
    def time_s(self) -> float:
        """Simulated time since the last reset or load [s]."""
        return self._steps * TIME_STEP_S

    @property
    def _bodies(self) -> Physics:
        if self._physics is None:
            raise OsfError("The table is empty; reset or load a scene first.")
        return self._physics

    def truth(self) -> SceneState:
        """Return the true state. It is for pictures and evaluation; estimators must not use it."""
        light = self._conditions.spot.distant if self._conditions.spot else self._light
        return SceneState(self.names, self._poses(), light, self._bodies.pusher)

    def _poses(self) -> Pose:
        return Pose.stacked(self._bodies.pose(name) for name in self.names)

    def arrange(self, seed: int) -> None:
        """Arrange a scene as `reset` does, without taking images.

        Raises:
            NoRoom: if the objects do not fit side by side.
        """
        rng = np.random.default_rng(seed)
        names = self._request.names
        if names is None:
            available = self._library.names() if self._request.among is None else self._request.among
            names = tuple(available[i] for i in rng.choice(len(available), self._request.count, replace=False))
        self._load_objects(names)
        place_randomly(self._bodies, self.assets, rng, is_upright=self._request.is_upright)
        drawn = Light.random(rng)  # drawn in any case, so that a given light leaves the rest of the scene alone
        self._light = drawn if self._request.light is None else self._request.light
        self._steps = 0

    def load(self, state: SceneState) -> None:
        """Put exactly this state on the table, at rest. Without a pusher in the state, it is parked in a corner.

        Raises:
            UnknownName: if there is no such object.
            MissingAssets: if the mesh of an object has not been fetched.
            InvalidInput: if an object is not over the table.
            OverlappingObjects: if bodies penetrate by more than 2 mm. The table is then unchanged.
        """
        for name in state.names:
            self._library.check(name)
            check_place(name, state.pose(name).position)
        before = self.truth() if self._physics else None
        self._place_all(state)
        try:
            refuse_overlaps(self._bodies, self.names)
        except OverlappingObjects:
            if before is None:
                self.close()
            else:
                self._place_all(before)
            raise
        self._steps = 0

    def load_measured(self, state: SceneState) -> None:
        """Load measured poses. Objects that sink into the table are lifted, and those that overlap are moved apart.

        Raises:
            UnknownName: if there is no such object.
            MissingAssets: if the mesh of an object has not been fetched.
            InvalidInput: if an object is not over the table.
        """
        positions = np.maximum(state.poses.position, [-np.inf, -np.inf, 0.0])  # no centre below the table
        state = replace(state, poses=Pose(positions, state.poses.quaternion))
        for name in state.names:
            check_place(name, state.pose(name).position)
        self.restore(state)
        move_apart(self._bodies, self.names)

    def restore(self, state: SceneState) -> None:
        """Put back an earlier true state of a world, at rest.

        Unlike `load`, it does not check for overlaps, because contact may leave bodies slightly inside each other.

        Raises:
            UnknownName: if there is no such object.
            MissingAssets: if the mesh of an object has not been fetched.
        """
        for name in state.names:
            self._library.check(name)
        self._place_all(state)
        self._steps = 0

    def act_steps(self, action: Float[np.ndarray, "3"], rate_hz: float = 60.0) -> Iterator[SceneState]:
        """Act as `act` does; yield the true state about `rate_hz` times per simulated second, and at the end.

        Raises:
            InvalidInput: if the action is outside its limits. The world is then unchanged.
        """
        velocity = check_action(action)
        stride = _stride(rate_hz)
        for step in range(1, SUBSTEPS + 1):
            self._advance(velocity)
            if step % stride == 0 or step == SUBSTEPS:
                yield self.truth()

    def act_recorded(self, action: Float[np.ndarray, "3"], instants: int) -> tuple[frozenset[str], Pose]:
        """Act as `act` does, and record the motion.

        Args:
            action: velocity (vx, vy, 0) of the pusher in the world [m/s].
            instants: number of poses to record, at equal intervals. The last one is at the end of the action.

        Returns:
            Names of the objects that the pusher touched, and poses `T_world_object`, a batch of (instants, N).

        Raises:
            InvalidInput: if the action is outside its limits, or `instants` does not divide 48. The world is then
                unchanged.
        """
        velocity = check_action(action)
        if instants < 1 or SUBSTEPS % instants:
            raise InvalidInput("instants within an action", instants, f"a divisor of {SUBSTEPS}")
        stride = SUBSTEPS // instants
        touched, poses = frozenset[str](), []
        for step in range(1, SUBSTEPS + 1):
            touched |= self._advance(velocity)
            if step % stride == 0:
                poses.append(self._poses())
        return touched, Pose.stacked(poses)

    def settle(self, rate_hz: float = 60.0) -> Iterator[SceneState]:
        """Simulate until everything rests, 3 s at most; yield the true state `rate_hz` times per simulated second."""
        stride = _stride(rate_hz)
        for step in range(1, round(_SETTLE_LIMIT_S / TIME_STEP_S) + 1):
            self._advance(np.zeros(3))
            if step % stride == 0:
                yield self.truth()
                if is_calm(self._bodies, self.names):
                    return

    def move_object(self, name: str, pose: Pose) -> None:
        """Put one object at rest at `T_world_object`.

        Raises:
            UnknownName: if the object is not on the table.
            InvalidInput: if the pose is not finite or not over the table, or its quaternion is not unit.
            OverlappingObjects: if it would penetrate something by more than 2 mm. Nothing is then moved.
        """
        check_known("object on the table", [name], self.names)
        position = finite_vector(pose.position, 3, f"position of {name} [m]")
        check_place(name, position)
        quaternion = unit_quaternion(pose.quaternion, f"quaternion of {name}")
        bodies = self._bodies
        before = bodies.pose(name)
        bodies.place(name, Pose(position, quaternion))
        try:
            refuse_overlaps(bodies, self.names, name)
        except OverlappingObjects:
            bodies.place(name, before)
            raise

    def gap_m(self, name: str) -> float:
        """Return the gap to the nearest other object [m], 0.05 at most; negative if they penetrate each other."""
        others = [other for other in self.names if other != name]
        return min((self._bodies.distance(name, other) for other in others), default=0.05)

    def set_light(self, light: Light) -> None:
        """Set the light of the scene."""
        self._light = light

    def render(self, cameras: tuple[Camera, ...], *, masks: bool = False, with_pusher: bool = True) -> Observation:
        """Take images of the present state with these cameras.

        Args:
            cameras: cameras of one image size.
            masks: whether to return the visible pixels of each object as well.
            with_pusher: whether the images show the pusher.

        Raises:
            InvalidInput: if there is no camera, or the cameras differ in image size.
            OsfError: if the table is empty.
        """
        if len({(c.width, c.height) for c in cameras}) != 1:
            raise InvalidInput("image sizes", [(c.width, c.height) for c in cameras], "the same for all cameras")
        pictures = self.pictures(cameras, with_pusher=with_pusher)
        return Observation(
            cameras=cameras,
            images=np.stack([picture.rgb for picture in pictures]),
            names=self.names,
            masks=np.stack([masks_of(picture, len(self.names)) for picture in pictures]) if masks else None,
            pusher=self._bodies.pusher if with_pusher else None,
            time_s=self.time_s,
        )

    def pictures(
        self, cameras: tuple[Camera, ...], *, with_pusher: bool = True, with_objects: bool = True
    ) -> tuple[Picture, ...]:
        """Take images with coverage and depth, for evaluation; with or without pusher and objects."""
        state = self.truth() if with_pusher else replace(self.truth(), pusher=None)
        if not with_objects:
            state = replace(state, names=(), poses=Pose(np.zeros((0, 3)), np.zeros((0, 4))))
        if self._conditions.renderer == "tiny":
            if self._tiny is None:
                from osfcore.world.tiny_renderer import TinyScene  # knows PyBullet, which need not be there

                self._tiny = TinyScene(self.assets)
            return self._tiny.render(state, cameras)
        self._meshes |= {name: TracedMesh(self._asset(name).mesh) for name in self.names if name not in self._meshes}
        c = self._conditions
        tracer = RayTracer(self._meshes, lamp=c.lamp, table=c.table, spot=c.spot, executor=self._executor)
        return tracer.render(state, cameras)

    def _asset(self, name: str) -> ObjectAsset:
        if name not in self._assets:
            self._assets[name] = self._library.load(name)
        return self._assets[name]

    def _advance(self, velocity: Float[np.ndarray, "3"]) -> frozenset[str]:
        self._steps += 1
        return self._bodies.step(velocity)

    def _load_objects(self, names: tuple[str, ...]) -> None:
        self._models |= {name: body_model(self._asset(name)) for name in names if name not in self._models}
        self.close()
        self.names, c = names, self._conditions
        self._physics = simulate(self.models, c.simulator, friction_factor=c.friction_factor, mass_factor=c.mass_factor)

    def _place_all(self, state: SceneState) -> None:
        self._load_objects(state.names)
        for i, name in enumerate(state.names):
            self._bodies.place(name, state.poses[i])
        parked = np.array([PUSHER_REACH_M, PUSHER_REACH_M, PUSHER_CENTRE_Z_M])
        self._bodies.place_pusher(parked if state.pusher is None else state.pusher)
        self._light = state.light


def _stride(rate_hz: float) -> int:
    """Return the number of physics steps between two states."""
    return max(round(1 / (rate_hz * TIME_STEP_S)), 1)


# Worlds by name. Other packages can add more (`osfcore.plugins`).


WORLD = PartKind("world", ("reset", "observe", "act", "close", "truth", "render"))


@dataclass(frozen=True, eq=False, slots=True)
class WorldInputs:
    """Inputs of a factory of worlds.

    Attributes:
        library: library of the objects' meshes.
        request: scene that `reset` arranges.
        simulator: what moves the objects.
    """

    library: AssetLibrary
    request: SceneRequest
    simulator: Simulator = field(default_factory=default_simulator)


WORLDS: Mapping[str, Callable[[WorldInputs], SimulatedWorld]] = {
    "simulated": lambda given: Tabletop(
        given.library, request=given.request, conditions=Conditions(simulator=given.simulator)
    ),
    "tinyrenderer": lambda given: Tabletop(
        given.library, request=given.request, conditions=Conditions(renderer="tiny", simulator=given.simulator)
    ),
}
