"""Commands to the process that simulates the scenes, and its events: frozen dataclasses only."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float, UInt8

from osfcore.geometry.cameras import DEFAULT_IMAGE_SIDE, Camera
from osfcore.geometry.light import Light
from osfcore.geometry.poses import Pose
from osfcore.geometry.states import Observation, SceneState


@dataclass(frozen=True, eq=False, slots=True)
class SceneRecord:
    """A scene as the simulation last reported it.

    Attributes:
        id: identifier.
        seed: from which it was drawn.
        created_at: UTC, ISO 8601.
        image_size: side of its camera images [px].
        initial: where `reset` goes back to.
        state: where everything is now.
        time_s: simulated time since creation or reset [s].
        revision: grows with every change.
    """

    id: str
    seed: int
    created_at: str
    image_size: int
    initial: SceneState
    state: SceneState
    time_s: float
    revision: int


# Commands to the simulation.


@dataclass(frozen=True, eq=False, slots=True)
class CreateScene:
    """Make a scene: random from the seed, or with given poses. Answered by a SceneRecord.

    Measured poses may err: objects that penetrate are moved apart, and all come to rest as if let go.
    """

    id: str
    seed: int
    created_at: str
    image_size: int
    names: tuple[str, ...] | None
    count: int
    light: Light | None
    poses: Pose | None  # of `names`; None for random ones
    is_measured: bool = False


@dataclass(frozen=True, eq=False, slots=True)
class AdoptScene:
    """Take over a scene that was known before this simulation started, or put one back. Answered by its SceneRecord."""

    record: SceneRecord


@dataclass(frozen=True, slots=True)
class DropScene:
    """Forget a scene."""

    id: str


@dataclass(frozen=True, slots=True)
class ResetScene:
    """Go back to how the scene was created. Answered by a SceneRecord."""

    id: str


@dataclass(frozen=True, eq=False, slots=True)
class EditScene:
    """Move light and objects by hand, all or nothing. Answered by a SceneRecord.

    With `settle`, the objects then come to rest as if let go.
    """

    id: str
    light: Light | None = None
    poses: tuple[tuple[str, Pose], ...] = ()
    settle: bool = False


@dataclass(frozen=True, slots=True)
class Disturb:
    """Dim the light, or cover a camera; undo it where that is so already. Answered by a `Disturbance`."""

    id: str
    camera: str | None  # None for the light


@dataclass(frozen=True, slots=True)
class UndoDisturbances:
    """Back to the light and cameras as they are. Answered by None."""

    id: str


@dataclass(frozen=True, eq=False, slots=True)
class Act:
    """Hold each velocity [m/s] for one step. Answered by a SceneRecord."""

    id: str
    actions: tuple[Float[np.ndarray, "3"], ...]


@dataclass(frozen=True, slots=True)
class TakeImage:
    """One camera's image as PNG, with the masks drawn over it on demand. Answered by bytes."""

    id: str
    camera: str
    size: int
    masks: bool = False
    pusher: bool = True


@dataclass(frozen=True, eq=False, slots=True)
class TakeView:
    """What any camera would see. Answered by its 8-bit RGB image."""

    id: str
    camera: Camera
    pusher: bool = True


@dataclass(frozen=True, slots=True)
class TakeMask:
    """The visible pixels of one object, as 8-bit PNG of 0 and 255. Answered by bytes."""

    id: str
    camera: str
    object: str
    size: int


@dataclass(frozen=True, slots=True)
class ObserveScene:
    """What the robot sees of a scene now. Answered by an ObservedScene.

    Attributes:
        id: of the scene.
        goal: the goal camera's view alone, without the pusher.
        masks: whether to count each object's visible pixels.
    """

    id: str
    goal: bool
    masks: bool


@dataclass(frozen=True, eq=False, slots=True)
class ObservedScene:
    """A scene and what the robot sees of it.

    Attributes:
        record: the scene when it was observed.
        observation: images have the 256 values of a camera's; nothing in it says where objects truly are.
    """

    record: SceneRecord
    observation: Observation


@dataclass(frozen=True, eq=False, slots=True)
class ComposeGoal:
    """How a scene could become, seen by the goal camera without the pusher. Answered by a ComposedGoal.

    The scene stays as it is.

    Attributes:
        id: of the scene.
        poses: of objects that lie elsewhere; they come to rest as if let go.
        seed: of a random layout, instead of poses; None for the poses.
        moved: objects that a random layout moves; as the seed will have it if None.
        light: in which it is seen; None for the scene's.
        size: side of the image [px].
        is_measured: the poses may err: objects that penetrate are moved apart first.
    """

    id: str
    poses: tuple[tuple[str, Pose], ...] = ()
    seed: int | None = None
    moved: int | None = None
    light: Light | None = None
    size: int = DEFAULT_IMAGE_SIDE
    is_measured: bool = False


@dataclass(frozen=True, eq=False, slots=True)
class ComposedGoal:
    """How a scene could become.

    Attributes:
        png: what the goal camera sees.
        poses: of all objects, at rest.
    """

    png: bytes
    poses: tuple[tuple[str, Pose], ...]


@dataclass(frozen=True, slots=True)
class ShowScene:
    """Which scene's camera images are wanted live; None for no scene."""

    id: str | None


@dataclass(frozen=True, slots=True)
class WatchFrames:
    """Whether anyone looks at live camera images."""

    wanted: bool


Command = (
    CreateScene
    | AdoptScene
    | DropScene
    | ResetScene
    | EditScene
    | Act
    | Disturb
    | UndoDisturbances
    | TakeImage
    | TakeView
    | TakeMask
    | ObserveScene
    | ComposeGoal
    | ShowScene
    | WatchFrames
)

JobCommand = Act | ObserveScene | TakeView  # what a job may do with the scene that it drives


# Events of the simulation.


@dataclass(frozen=True, eq=False, slots=True)
class SceneChanged:
    """A scene has changed.

    Attributes:
        record: how it is now.
        states: the way there, `interval_s` apart in simulated time, the end included; empty for a jump.
        interval_s: time between two states [s].
    """

    record: SceneRecord
    states: tuple[SceneState, ...] = ()
    interval_s: float = 0.0


@dataclass(frozen=True, eq=False, slots=True)
class FramesTaken:
    """Live images of a scene's cameras.

    Attributes:
        scene: identifier of the scene.
        revision: of the scene when they were taken.
        names: of the cameras.
        images: 8-bit RGB.
        jpegs: the same, encoded.
    """

    scene: str
    revision: int
    names: tuple[str, ...]
    images: UInt8[np.ndarray, "V h w 3"]
    jpegs: tuple[bytes, ...]
