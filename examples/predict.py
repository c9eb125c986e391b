"""Predict what a push of 1.2 s does to two objects, with the shipped graph network."""

import numpy as np
from scene import table

from osfcore import FieldLibrary, load_push_model


def main() -> None:
    """Push the can along +x, and compare with a push that misses everything."""
    state = table()
    model = load_push_model(None, FieldLibrary(None), state.names)
    from_behind = np.array([state.poses.position[0, 0] - 0.08, state.poses.position[0, 1], state.pusher[2]])
    state = type(state)(state.names, state.poses, state.light, from_behind)
    actions = np.zeros((2, 6, 3))
    actions[0, :, 0] = 0.12  # toward the can
    actions[1, :, 1] = -0.12  # past it
    rollouts = model.rollout(state, actions)
    for number, what in enumerate(("through the can", "past everything")):
        moved = 1000 * np.linalg.norm(rollouts.positions[number, -1] - rollouts.positions[number, 0], axis=1)
        print(what + ":", ", ".join(f"{name} {mm:.0f} mm" for name, mm in zip(state.names, moved, strict=True)))


if __name__ == "__main__":
    main()
