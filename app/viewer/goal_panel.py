"""Composing a goal in the 3D view: golden copies of the objects, to be dragged and turned.

Drafts come from whoever changes them and are only stored; drawing happens in the thread. Hands are answered by the
simulation, so what they moved is on its way for a moment: until then it stays where it was let go.
"""

from __future__ import annotations

from collections.abc import Callable
from concurrent.futures import Executor

import numpy as np
import viser
from jaxtyping import Float

from osfcore.geometry.poses import Pose, quaternion_multiply
from osfcore.objects.asset_library import AssetLibrary

from ..services.event_hub import CurrentScene
from ..services.goals import DraftChanged, Goals
from .drawing import Panel, RunCommand
from .nodes.episode_nodes import GOAL, add_copy
from .nodes.ghosts import size_m
from .nodes.room import NO_TURN, Colour, atomic, put, send_again
from .nodes.scene_nodes import Client, level_point

WRONG = (225, 30, 35)
_RING_BESIDE_M = 0.015  # of the copy, which is what a hand takes where both are
_RING = 0.65  # radius of a gizmo's ring, as a share of the gizmo's scale
_WORDS_AT = (0.0, 0.0, 0.3)


class GoalPanel(Panel):
    """The nodes of a goal that is being composed; the same in all browsers.

    Args:
        server: to draw in.
        library: meshes of the objects.
        goals: what is composed.
        commands: carries out what hands do; viser's loop must not wait for it.
        run_command: carries out a command and notifies its client if it is refused.
    """

    def __init__(
        self,
        server: viser.ViserServer,
        library: AssetLibrary,
        goals: Goals,
        commands: Executor,
        run_command: RunCommand,
    ) -> None:
        super().__init__("goal-panel")
        self._server = server
        self._library = library
        self._goals = goals
        self._commands = commands
        self._run_command = run_command
        self._draft = goals.draft
        self._copies: dict[str, _Copy] = {}
        self._is_astray = False  # copies may be elsewhere in a browser, or in hands that may hold them no longer
        self._words = server.scene.add_label(
            "/goal/problem", "", position=_WORDS_AT, visible=False, font_screen_scale=1.0, anchor="bottom-center"
        )

    def _store(self, event: object) -> bool:
        if isinstance(event, DraftChanged):
            self._draft = event.draft
        return isinstance(event, DraftChanged | CurrentScene)

    @property
    def is_composing(self) -> bool:
        """Whether handles of a goal are on view."""
        with self._thread.changed:
            return self._draft is not None and self._draft.scene == self._current

    def put_handles_back(self) -> None:
        """Show all copies where the draft has them, in every browser. Any thread may call."""
        with self._thread.changing():
            self._is_astray = True

    # The thread

    def _draw(self) -> None:
        with self._thread.changed:
            draft = self._draft if self.is_composing else None
            is_astray, self._is_astray = self._is_astray, False
        poses, problem = ({}, "") if draft is None else (dict(draft.poses), draft.problem)
        with atomic(self._server):
            for name in set(self._copies) - set(poses):
                self._copies.pop(name).remove()
            for name, pose in poses.items():
                if name not in self._copies:
                    self._copies[name] = _Copy(self._server.scene, self._library, name, self._let_go)
                if is_astray:
                    self._copies[name].put_back()
                self._copies[name].place(pose, WRONG if problem else GOAL)
            self._words.text, self._words.visible = self._library.in_words(problem), bool(problem)

    def _let_go(self, copy: _Copy, grip: int, pose: Pose, client: Client) -> None:
        """A copy was let go; where that is refused, it goes back. Called on viser's loop."""

        def move() -> None:
            try:
                self._goals.move_draft(((copy.name, pose),))
            finally:
                copy.release(grip)
                self._thread.wake()

        self._commands.submit(self._run_command, move, client)


class _Copy:
    """A golden copy of an object, to be dragged over the table, with a ring that turns it about the vertical.

    Args:
        scene: to draw in.
        library: meshes of the objects.
        name: of the object.
        on_release: called on viser's loop when somebody has let it go, with the number of the grip; must be quick.
    """

    def __init__(
        self,
        scene: viser.SceneApi,
        library: AssetLibrary,
        name: str,
        on_release: Callable[[_Copy, int, Pose, Client], None],
    ) -> None:
        self.name = name
        self._grip = 0
        self._is_held = False  # follows the hand, not the draft
        self._laid = Pose.identity()
        path = f"/goal/objects/{name}"
        # The shape hangs on the ring, so that it turns at once in the browser of whoever turns it.
        self._ring = scene.add_transform_controls(
            path,
            scale=(float(np.linalg.norm(size_m(library, name))) / 2 + _RING_BESIDE_M) / _RING,
            active_axes=(True, True, False),
            disable_axes=True,
            disable_sliders=True,
            depth_test=False,
        )
        self._shape = add_copy(scene, f"{path}/shape", library, name)
        offset_m = np.zeros(3)  # from the copy's origin to where the hand has it

        def hold(phase: str, client: Client) -> None:
            self._grip += phase == "start"
            self._is_held = True
            if phase == "end":
                on_release(self, self._grip, self._pose(), client)

        async def turn(event: viser.TransformControlsEvent) -> None:
            hold(event.phase, event.client)

        async def drag(event: viser.SceneNodeDragEvent[viser.MeshHandle]) -> None:
            nonlocal offset_m
            if event.phase == "start":
                offset_m = np.asarray(event.start_position, float) - self._ring.position
            eye, pointed = np.asarray(event.client.camera.position), np.asarray(event.end_position, float)
            at = level_point(eye, pointed, self._laid.position[2] + offset_m[2])
            if at is not None:
                put(self._ring, at - offset_m)
            hold(event.phase, event.client)

        self._ring.on_update(turn)
        self._shape.on_drag(drag)

    def release(self, grip: int) -> None:
        """The draft has taken over what a hand did, unless a hand is at it again."""
        self._is_held = self._is_held and grip != self._grip

    def place(self, pose: Pose, colour: Colour) -> None:
        """Give it a colour, and put it where the draft has it, unless somebody holds it."""
        if not self._is_held:
            self._laid = pose
            put(self._ring, pose.position, NO_TURN)
            put(self._shape, np.zeros(3), pose.quaternion)
        self._shape.color = colour

    def remove(self) -> None:
        """Remove it with its ring."""
        self._ring.remove()

    def put_back(self) -> None:
        """Take it out of all hands, and send where it is once more."""
        self._is_held = False
        send_again(self._ring)

    def _pose(self) -> Pose:
        """Where it was dragged to, at the height and with the tilt of the draft; browsers may send anything."""
        x, y = np.asarray(self._ring.position, float)[:2]
        turn = quaternion_multiply(_about_z(np.asarray(self._ring.wxyz, float)), self._laid.quaternion)
        if not np.all(np.isfinite([x, y])):
            return self._laid
        return Pose(np.array([x, y, self._laid.position[2]]), turn)


def _about_z(turn: Float[np.ndarray, "4"]) -> Float[np.ndarray, "4"]:
    """Take the part of a rotation that is about the vertical; none for what is no rotation."""
    flat = turn * np.array([1.0, 0.0, 0.0, 1.0])
    length = float(np.linalg.norm(flat))
    return flat / length if np.isfinite(length) and length > 1e-6 else NO_TURN
