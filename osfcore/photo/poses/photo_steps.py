"""What the estimation of a photographed scene yields, and its result."""

from __future__ import annotations

from dataclasses import dataclass

from osfcore.geometry.poses import Pose
from osfcore.photo.poses.table_from_objects import TableGuess
from osfcore.progress import Progress


@dataclass(frozen=True, eq=False, slots=True)
class PhotoPose:
    """One pose of an object, with how well it explains the photographs.

    Attributes:
        pose: `T_world_object`.
        loss: of `PoseLoss`.
        iou: of drawn outline and mask.
        residual: relative error of the colours.
        correlation: of the band-passed images.
    """

    pose: Pose
    loss: float
    iou: float
    residual: float
    correlation: float


@dataclass(frozen=True, eq=False, slots=True)
class PhotoObject:
    """What was found of one object.

    Attributes:
        name: of the object.
        best: the most likely pose.
        rivals: other orientations, the best first; a person may choose one.
        doubt: why it should not be trusted, in a sentence; "" where it may be.
        seconds: that the search over rotations and the refinement took.
    """

    name: str
    best: PhotoPose
    rivals: tuple[PhotoPose, ...]
    doubt: str
    coarse_s: float
    refine_s: float

    @property
    def ratio(self) -> float:
        """Loss of the best rival over that of the pose; infinite without rivals."""
        return self.rivals[0].loss / max(self.best.loss, 1e-9) if self.rivals else float("inf")


@dataclass(frozen=True, eq=False, slots=True)
class PhotoStep:
    """One step of the estimation.

    Attributes:
        progress: how far the work is.
        found: objects so far, in the photographs' world.
        table: what objects were found to lie on, where no photograph tells; with the last step only.
    """

    progress: Progress
    found: tuple[PhotoObject, ...]
    table: TableGuess | None = None
