"""How a table could become: with objects where a hand puts them, or somewhere at random."""

from __future__ import annotations

import numpy as np

from app.messages import ComposeGoal
from osfcore.errors import InvalidInput, NoRoom, UnknownName
from osfcore.evaluate.mpc_tasks import draw_goal
from osfcore.poses import Pose
from osfcore.scene import SceneState
from osfcore.world.tabletop import Tabletop

_GOALS = 30  # random ones that are tried until one has room
_SUNK_M = 0.02  # whatever lies this deep lies beside the table


def composed(world: Tabletop, wanted: ComposeGoal) -> SceneState:
    """The table as it is wanted, at rest; the world is left like that, or anyhow if it cannot be.

    Raises:
        UnknownName: if an object is not on the table.
        InvalidInput: if an object would not be over the table, or more shall move than there are.
        OverlappingObjects: if objects would overlap.
        NoRoom: if no random layout has room.
    """
    if wanted.seed is not None:
        goal, _ = random_goal(world, wanted.seed, wanted.moved)
    else:
        goal = _arranged(world, dict(wanted.poses))
    if wanted.light is not None:
        world.set_light(wanted.light)
    return goal


def random_goal(world: Tabletop, seed: int, moved: int | None) -> tuple[SceneState, tuple[str, ...]]:
    """A random layout with some objects elsewhere, and which; the world is left like that.

    Raises:
        InvalidInput: if more shall move than there are.
        NoRoom: if none has room.
    """
    start = world.truth()
    if moved is not None and not 1 <= moved <= len(start.names):
        raise InvalidInput("number of objects that move", moved, f"between 1 and {len(start.names)}")
    for attempt in range(_GOALS):
        rng = np.random.default_rng([seed, attempt])
        count = int(rng.integers(1, len(start.names) + 1)) if moved is None else moved
        world.restore(start)
        found = draw_goal(world, count, rng)
        if found is not None:
            return found
    raise NoRoom(start.names, _GOALS)


def _arranged(world: Tabletop, poses: dict[str, Pose]) -> SceneState:
    state = world.truth()
    for name in poses:
        if name not in state.names:
            raise UnknownName("object on the table", name, state.names)
    every = [poses.get(name, state.pose(name)) for name in state.names]
    stacked = Pose(np.array([p.position for p in every]), np.array([p.quaternion for p in every]))
    world.load(SceneState(state.names, stacked, state.light, None))
    for _ in world.settle():
        pass
    rests = world.truth()
    for name in rests.names:
        if (position := rests.pose(name).position)[2] < -_SUNK_M:
            allowed = "where it does not fall off the table"
            raise InvalidInput(f"position of {name} [m]", np.round(position, 4).tolist(), allowed)
    return rests
