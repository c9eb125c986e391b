"""Push-T as gym-pusht publishes it (Chi et al., 2023), and copies of it that planners look ahead with.

A round pusher moves a T on a plane of 512 px until the T covers 95 % of its outline at the goal. The environment's
actions are targets, to which a spring and a damper draw the pusher, ten times a second. Ours are velocities, held for
0.2 s: two of its steps, in each of which the target is as far ahead as makes the pusher keep that velocity.
"""

from __future__ import annotations

import os
from collections.abc import Callable
from typing import Any

import numpy as np
from jaxtyping import Float

from osfcore.errors import OsfError
from osfcore.geometry.workspace import STEP_S

STATE = 7  # place and velocity of the pusher [px, px/s], origin [px] and angle [rad] of the T
PX_M = 0.001  # 1 px is 1 mm: then the pusher's radius of 15 px is that of ours

# Moves K copies of the plane on by an action each.
Step = Callable[[Float[np.ndarray, "K 7"], Float[np.ndarray, "K 2"]], Float[np.ndarray, "K 7"]]


class MissingPushT(OsfError):
    """The benchmark is not installed."""

    def __init__(self) -> None:
        super().__init__(
            "Push-T needs gym-pusht and pytorch-mppi; install them with: pip install 'osf-manipulation[pusht]' && "
            "pip install --no-deps gym-pusht==0.1.8."
        )


class _Instance:
    """One instance of the environment; its pusher is told velocities.

    Attributes:
        env: of gym-pusht, which has no types.
        steps: of the environment in one of our actions.
        substeps: of the physics in one of those.
    """

    def __init__(self) -> None:
        os.environ.setdefault("PYGAME_HIDE_SUPPORT_PROMPT", "1")  # it would be printed among the figures
        try:
            from gym_pusht.envs.pusht import PushTEnv  # pyright: ignore[reportMissingImports]  an extra
        except ImportError:
            raise MissingPushT from None
        self.env: Any = PushTEnv()
        self.env.reset(seed=0)
        self.steps = round(STEP_S * self.env.control_hz)
        self.substeps = int(1 / (self.env.dt * self.env.control_hz))  # as in its own step
        space = self.env.action_space
        self._low, self._high, self._lead_px = float(space.low.min()), float(space.high.max()), self._lead_s() / PX_M

    @property
    def state(self) -> Float[np.ndarray, "7"]:
        """Where everything is."""
        agent, block = self.env.agent, self.env.block
        return np.array([*agent.position, *agent.velocity, *block.position, block.angle])

    def target(self, velocity: Float[np.ndarray, "2"]) -> tuple[float, float]:
        """The environment's action that lets the pusher keep a velocity [m/s], within the plane."""
        x, y = self.env.agent.position
        return self._within(x + self._lead_px * velocity[0]), self._within(y + self._lead_px * velocity[1])

    def _within(self, at: float) -> float:
        return min(max(float(at), self._low), self._high)

    def _lead_s(self) -> float:
        """How far ahead a target is of a pusher that moves by its velocity u times the duration h of each step [s].

        A step multiplies (x - target, v) by P. Then v is the same before and after it for v = -P10 lead u / (1 - P11),
        and x moves by h u.
        """
        dt, k_p, k_v = self.env.dt, self.env.k_p, self.env.k_v
        one = np.array([[1 - k_p * dt**2, dt - k_v * dt**2], [-k_p * dt, 1 - k_v * dt]])
        P = np.linalg.matrix_power(one, self.substeps)
        return float(self.substeps * dt / (1 - P[0, 0] - P[0, 1] * P[1, 0] / (1 - P[1, 1])))


class PushT:
    """The environment that is acted on.

    Raises:
        MissingPushT: if gym-pusht is not installed.
    """

    def __init__(self) -> None:
        self._own = _Instance()

    def reset(self, seed: int) -> None:
        """Begin anew, as the environment draws it from a seed."""
        self._own.env.reset(seed=seed)

    @property
    def state(self) -> Float[np.ndarray, "7"]:
        """Where pusher and T are."""
        return self._own.state

    @property
    def goal(self) -> Float[np.ndarray, "3"]:
        """Where the T should be: origin [px] and angle [rad]."""
        return np.asarray(self._own.env.goal_pose, float)

    @property
    def success_coverage(self) -> float:
        """Share of the goal that the T has to cover."""
        return float(self._own.env.success_threshold)

    def coverage(self) -> float:
        """Share of the goal that the T covers."""
        return float(self._own.env._get_coverage())

    def act(self, velocity: Float[np.ndarray, "2"]) -> float:
        """Execute one action, unless the goal is reached half-way.

        Args:
            velocity: of the pusher [m/s].

        Returns:
            The largest coverage at the end of one of the environment's steps.
        """
        most = 0.0
        for _ in range(self._own.steps):
            *_, is_done, _, info = self._own.env.step(np.array(self._own.target(velocity)))
            most = max(most, float(info["coverage"]))
            if is_done:
                break
        return most


class Simulation:
    """Another instance of the environment, put into any state: the true dynamics.

    The physics engine warm-starts its contact solver with the impulses of the step before, which are in no state: what
    is foretold of an action differs from what happens by a fraction of a pixel, by more where the T is jammed against a
    wall.

    Raises:
        MissingPushT: if gym-pusht is not installed.
    """

    def __init__(self) -> None:
        self._own = _Instance()

    def __call__(
        self, states: Float[np.ndarray, "K 7"], velocities: Float[np.ndarray, "K 2"]
    ) -> Float[np.ndarray, "K 7"]:
        """States after one action each [m/s]."""
        return np.array([self._after(state, velocity) for state, velocity in zip(states, velocities, strict=True)])

    def _after(self, state: Float[np.ndarray, "7"], velocity: Float[np.ndarray, "2"]) -> Float[np.ndarray, "7"]:
        self._forget_contacts()
        self._put(state.tolist())
        for _ in range(self._own.steps):
            self._follow(*self._own.target(velocity))
        return self._own.state

    def _forget_contacts(self) -> None:
        """Let a moment pass in which nothing is near anything, and keep no contact from before it."""
        env = self._own.env
        env.agent.velocity = env.block.velocity = (0.0, 0.0)
        env.agent.position, env.block.position = (-1e3, -1e3), (1e3, 1e3)
        kept, env.space.collision_persistence = env.space.collision_persistence, 0
        env.space.step(env.dt)
        env.space.collision_persistence = kept

    def _put(self, state: list[float]) -> None:
        agent, block = self._own.env.agent, self._own.env.block
        agent.position, agent.velocity = tuple(state[:2]), tuple(state[2:4])
        block.angle = state[6]  # first, for it turns the T about its centre of mass
        block.position = tuple(state[4:6])
        block.velocity, block.angular_velocity = (0.0, 0.0), 0.0  # which full damping makes of them in any case

    def _follow(self, x: float, y: float) -> None:
        """One of the environment's steps, without the areas and observations that its own `step` computes."""
        env, agent = self._own.env, self._own.env.agent
        for _ in range(self._own.substeps):
            (at_x, at_y), (v_x, v_y) = agent.position, agent.velocity
            agent.velocity = (
                v_x + (env.k_p * (x - at_x) - env.k_v * v_x) * env.dt,
                v_y + (env.k_p * (y - at_y) - env.k_v * v_y) * env.dt,
            )
            env.space.step(env.dt)


def drift(states: Float[np.ndarray, "K 7"], velocities: Float[np.ndarray, "K 2"]) -> Float[np.ndarray, "K 7"]:
    """States after one action each if the pusher met nothing: dynamics that cost next to no time."""
    after = states.copy()
    after[:, 2:4] = velocities / PX_M
    after[:, :2] += STEP_S * after[:, 2:4]
    return after
