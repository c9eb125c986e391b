"""Plan pushes by MPPI that bring a can 12 cm to the left, and carry the plan out in the predicted world."""

import numpy as np
from scene import table

from osfcore import (
    FieldLibrary,
    MPPIPlanner,
    Pose,
    PoseCost,
    PoseGoal,
    PushProposals,
    SceneState,
    load_push_model,
    load_shapes,
)

STEPS = 12


def main() -> None:
    """Replan after every two actions."""
    state, library, rng = table(), FieldLibrary(None), np.random.default_rng(0)
    model = load_push_model(None, library, state.names)
    planner = MPPIPlanner(model.rollout, PushProposals(load_shapes(None, library, state.names)))
    can = state.names[0]
    target = Pose(state.pose(can).position + np.array([0.0, 0.12, 0.0]), state.pose(can).quaternion)
    goal = PoseGoal.of(state, {can: target})
    for step in range(0, STEPS, 2):
        for _ in planner.plan(state, goal, PoseCost(goal), rng):
            pass
        actions = planner.nominal(2)
        future = model.rollout(state, actions[None])
        planner.shift(2)
        poses = Pose(future.positions[0, -1], future.quaternions[0, -1])
        pusher = state.pusher + 0.2 * actions.sum(axis=0)  # an action is a velocity that is held for 0.2 s
        state = SceneState(state.names, poses, state.light, pusher)
        left = 1000 * np.linalg.norm(poses.position[0] - target.position)
        print(f"after {step + 2:2d} actions the can is {left:3.0f} mm from its goal")


if __name__ == "__main__":
    main()
