"""The nodes that show the predicted future of a plan: ghosts on the way, at its end, and moving with the pusher."""

from __future__ import annotations

import numpy as np
import viser

from app.viewer.nodes.ghosts import add_ghosts, below_table, between, mesh_of, move_ghosts, moves, pose_at, way_of
from app.viewer.nodes.push_nodes import pusher_ghost
from osfcore.geometry.poses import Pose, rotation_angle
from osfcore.geometry.rollouts import Rollouts
from osfcore.objects.asset_library import AssetLibrary

ON_THE_WAY = 3  # pale ghosts between now and the end
_ARM_M = 0.05  # what turning by 1 rad counts on the way
_CELLS = 28
_OPACITY, _PALE = 0.45, 0.3  # the latter is a share of the former
_SCALE = 1.008  # or ghosts and the surfaces below them would flicker


class FutureNodes:
    """One future of the objects that move in it.

    Args:
        scene: to draw in.
        library: meshes of the objects.
        root: of its nodes.
        colour: of the ghosts, as batches of meshes take it.
    """

    def __init__(self, scene: viser.SceneApi, library: AssetLibrary, root: str, colour: tuple[int, int, int]) -> None:
        self._scene = scene
        self._library = library
        self._root = root
        self._colour = colour
        self._future: Rollouts | None = None
        self.ghosts: dict[str, viser.BatchedMeshHandle] = {}
        self._pusher = pusher_ghost(scene, f"{root}/pusher")

    @property
    def steps(self) -> int:
        """Actions until its end; 0 while none is shown."""
        return 0 if self._future is None else len(self._future.pusher[0]) - 1

    @property
    def nodes(self) -> tuple[viser.SceneNodeHandle, ...]:
        """Everything that is drawn."""
        return (self._pusher, *self.ghosts.values())

    def show(self, future: Rollouts | None) -> None:
        """Show the first of some rollouts, from its beginning, in place of the one before."""
        self._future = future
        if future is None:
            for node in self.nodes:
                node.visible = False
            return
        if set(future.names) != set(self.ghosts):
            for node in self.ghosts.values():
                node.remove()
            self.ghosts = {name: self._copies(name) for name in future.names}
        for n, name in enumerate(future.names):
            self.ghosts[name].visible = moves(way_of(future, n))
        self._pusher.visible = True
        self.at(0.0)

    def at(self, step: float) -> None:
        """Move the ghosts that go along to where things are after some actions; in between, halfway."""
        future = self._future
        if future is None:
            return
        for n, name in enumerate(future.names):
            if self.ghosts[name].visible:
                poses = way_of(future, n)
                now = pose_at(poses, step)
                still = poses[[*on_the_way(poses, ON_THE_WAY), -1]]
                positions = np.vstack([still.position, now.position])
                move_ghosts(self.ghosts[name], Pose(positions, np.vstack([still.quaternion, now.quaternion])))
        self._pusher.position = between(future.pusher[0], step)

    def _copies(self, name: str) -> viser.BatchedMeshHandle:
        """Ghosts of one object: on the way, at the end, and the one that goes."""
        count = ON_THE_WAY + 2
        return add_ghosts(
            self._scene,
            f"{self._root}/{name}",
            mesh_of(self._library, name, _CELLS),
            below_table(count),
            batched_scales=np.full(count, _SCALE),
            batched_colors=self._colour,
            batched_opacities=np.array([*[_PALE] * ON_THE_WAY, 1.0, 1.0]),
            opacity=_OPACITY,
        )


def on_the_way(poses: Pose, count: int) -> list[int]:
    """Rows that lie about evenly along a way, not in time: most futures begin with a gap."""
    shifts = np.linalg.norm(np.diff(poses.position, axis=0), axis=1)
    turns = rotation_angle(poses.quaternion[:-1], poses.quaternion[1:])
    gone = np.cumsum(shifts + _ARM_M * turns)
    rows = np.searchsorted(gone, gone[-1] * np.arange(1, count + 1) / (count + 1))
    return [min(int(row) + 1, len(gone)) for row in rows]
