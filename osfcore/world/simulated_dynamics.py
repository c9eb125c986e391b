"""The simulator as a dynamics model: an upper bound on what predictions can be worth to a planner."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np
from jaxtyping import Float

from osfcore.errors import InvalidInput
from osfcore.geometry.poses import Pose
from osfcore.geometry.rollouts import Rollouts, check_actions
from osfcore.geometry.states import SceneState
from osfcore.geometry.workspace import STEP_S
from osfcore.objects.asset import ObjectAsset
from osfcore.world.physics import SUBSTEPS, body_model, reached
from osfcore.world.scenes import is_calm
from osfcore.world.simulators import Simulator, default_simulator, simulate

_SPARE_M = 0.003  # beyond its way: so far the pusher must meet nothing for an action to be skipped


class SimulatedPushes:
    """Predicts pushes by simulating them, one sequence after another.

    While everything is at rest and the pusher only walks past, nothing is simulated. PyBullet remembers contacts when
    bodies are put back, so that a sequence may end a millimetre or two from where it ends alone.

    Args:
        assets: assets of the objects, by name.
        simulator: what simulates; PyBullet where it is installed if None.
    """

    def __init__(self, assets: Mapping[str, ObjectAsset], simulator: Simulator | None = None) -> None:
        models = {name: body_model(asset) for name, asset in assets.items()}
        self._physics = simulate(models, simulator or default_simulator())

    def close(self) -> None:
        """Free the simulation."""
        self._physics.close()

    def rollout(
        self, state: SceneState, actions: Float[np.ndarray, "K T 3"], before: SceneState | None = None
    ) -> Rollouts:
        """Simulate K sequences of T actions from a state in which everything is at rest.

        Args:
            state: state of exactly these objects, with its pusher.
            actions: velocities of the pusher [m/s].
            before: not used.

        Raises:
            InvalidInput: if actions are beyond their limits, or the state has no pusher.
        """
        actions = check_actions(actions)
        futures = [self._follow(state, sequence) for sequence in actions]
        poses = Pose.stacked(poses for poses, _ in futures)
        return Rollouts(state.names, poses.position, poses.quaternion, np.stack([pusher for _, pusher in futures]))

    def _follow(self, state: SceneState, actions: Float[np.ndarray, "T 3"]) -> tuple[Pose, Float[np.ndarray, "T1 3"]]:
        if state.pusher is None:
            raise InvalidInput("pusher of the state", "missing", "there")
        for n, name in enumerate(state.names):
            self._physics.place(name, state.poses[n])
        self._physics.place_pusher(state.pusher)
        poses, pusher = [state.poses], [state.pusher]
        for action in actions:
            if self._walks_past(state.names, action):
                poses.append(poses[-1])
            else:
                for _ in range(SUBSTEPS):
                    self._physics.step(action)
                poses.append(Pose.stacked(self._physics.pose(name) for name in state.names))
            pusher.append(self._physics.pusher)
        return Pose.stacked(poses), np.stack(pusher)

    def _walks_past(self, names: tuple[str, ...], action: Float[np.ndarray, "3"]) -> bool:
        """Move the pusher alone if it meets nothing on its way; return whether it did."""
        physics = self._physics
        if not is_calm(physics, names):
            return False
        way = STEP_S * action
        far = float(np.linalg.norm(way)) + _SPARE_M
        if any(physics.distance(name, None, far + _SPARE_M) < far for name in names):
            return False
        physics.place_pusher(reached(physics.pusher, way))
        return True
