"""Why a pose in a photograph should not be trusted, in a sentence."""

from __future__ import annotations

from collections.abc import Sequence

from osfcore.photo.poses.photo_steps import PhotoPose
from osfcore.photo.poses.pose_loss import PoseLoss

LEAST_RATIO = 1.15  # loss of another orientation over that of the best
_LEAST_IOU = 0.85
_MOST_RESIDUAL = 0.55
_MOST_CUT = 0.1  # of the mask's border lies on the photo's edge


def fits_outline(best: PhotoPose) -> bool:
    """Whether the drawn outline is that of the mask."""
    return best.iou >= _LEAST_IOU


def doubt_of(name: str, best: PhotoPose, rivals: Sequence[PhotoPose], loss: PoseLoss) -> str:
    """The first reason that applies; "" if none does.

    Args:
        name: of the object.
        best: its pose.
        rivals: other orientations, the best first.
        loss: whose windows the pose was found in.
    """
    if not fits_outline(best):
        return (
            f"The outline of {name} does not fit its mask (they share {100 * best.iou:.0f} %); "
            "check the name, the mask and the camera."
        )
    if best.residual > _MOST_RESIDUAL:
        return f"{name} does not look like what the photo shows there; check the name and the mask."
    if rivals and rivals[0].loss < LEAST_RATIO * best.loss:
        return f"{name} looks nearly the same in another orientation; choose between the two pictures."
    if min(window.cut for window in loss.windows) > _MOST_CUT:
        return f"{name} is cut off by the edge of the photo, so that its distance is uncertain."
    return ""
