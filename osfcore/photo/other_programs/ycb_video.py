"""The numbers of YCB-Video's objects, and the frames in which other programs tell poses of YCB objects.

Three frames of one object are in use; they have the same axes, and differ in where the origin lies:

- "bop": the centre of the mesh's bounding box, as in BOP's YCB-V, and here.
- "ycb_video": that of the models that came with YCB-Video (Xiang et al. 2018), of PoseCNN and what descends from it: up
  to 3 cm away. BOP's notes on its YCB-V tell the shifts.
- "google_16k": that of the meshes as YCB publishes them, in which the origin lies beside most objects.

The bounding boxes of BOP's models and of the google_16k meshes agree along each axis within 0.3 mm, so that their axes
are the same; but the wood block's is 13 mm wider in BOP, as if turned by about 9 degrees about z. Its poses are read as
they are, and right as starts only.
"""

from __future__ import annotations

from typing import Literal

import numpy as np

from osfcore.errors import InvalidInput, UnknownName
from osfcore.geometry.poses import Pose

ModelFrame = Literal["bop", "ycb_video", "google_16k"]

_Shift = tuple[float, float, float]
# Name, from YCB-Video's origin to the box's centre, and from google_16k's (None where that was not measured) [mm]
_ROWS: tuple[tuple[str, _Shift, _Shift | None], ...] = (
    ("002_master_chef_can", (-1.3360, 0.5000, -3.5105), (-17.05, -9.76, 69.90)),
    ("003_cracker_box", (-0.5575, -1.7005, -4.8050), (-12.88, -14.14, 103.48)),
    ("004_sugar_box", (0.9520, -1.4670, -4.3645), (-7.47, -16.71, 88.04)),
    ("005_tomato_soup_can", (0.0240, 1.5270, -8.4035), (-9.17, 84.02, 51.01)),
    ("006_mustard_bottle", (-1.2995, -2.4870, 11.8290), (-15.34, -23.50, 92.50)),
    ("007_tuna_fish_can", (0.1565, -0.1150, -4.2625), (-26.05, -22.13, 13.55)),
    ("008_pudding_box", (-1.1645, 4.2015, -3.1190), (0.50, 19.12, 18.95)),
    ("009_gelatin_box", (-1.4460, 0.5915, -3.6085), (-22.77, -8.24, 14.49)),
    ("010_potted_meat_can", (-2.4195, -0.3075, -8.0715), (-32.78, -26.55, 38.58)),
    ("011_banana", (18.6730, -12.1915, 1.4635), (11.48, -7.34, 17.96)),
    ("019_pitcher_base", (-5.3370, -5.8855, -25.6115), (-5.83, 40.05, 118.37)),
    ("021_bleach_cleanser", (-4.9290, 2.4800, 13.2920), (-21.66, 11.71, 124.84)),
    ("024_bowl", (0.2270, -0.7950, 2.9675), (-14.84, -43.69, 26.97)),
    ("025_mug", (8.4675, 0.6995, 1.6145), (-8.86, 17.34, 40.12)),
    ("035_power_drill", (-9.0710, -20.9360, 2.1190), (-45.96, 10.59, 25.47)),
    ("036_wood_block", (-1.4265, 2.5305, -17.1890), (23.71, -10.91, 102.94)),
    ("037_scissors", (-7.0535, 28.1320, -0.0420), None),
    ("040_large_marker", (-0.0460, 2.1040, -0.3500), None),
    ("051_large_clamp", (-10.5180, 1.9640, 0.4745), None),
    ("052_extra_large_clamp", (0.3950, 10.4130, -0.1620), None),
    ("061_foam_brick", (0.0805, -0.0805, 8.2435), (-18.26, 17.20, 25.25)),
)
NAMES: tuple[str, ...] = tuple(name for name, _, _ in _ROWS)
_SHIFTS_MM: dict[str, dict[str, _Shift]] = {
    "bop": dict.fromkeys(NAMES, (0.0, 0.0, 0.0)),
    "ycb_video": {name: shift for name, shift, _ in _ROWS},
    "google_16k": {name: shift for name, _, shift in _ROWS if shift is not None}
    | {
        "013_apple": (0.86, -3.78, 35.55),
        "016_pear": (-33.32, 17.99, 32.65),
        "022_windex_bottle": (18.29, 11.93, 134.25),
    },
}


def name_of(number: int) -> str:
    """The object with a number, from 1 (002_master_chef_can) to 21 (061_foam_brick), of BOP's YCB-V and PoseCNN.

    Raises:
        InvalidInput: if there is none.
    """
    if not 1 <= number <= len(NAMES):
        raise InvalidInput("number of the object", number, f"1 to {len(NAMES)}, as in YCB-Video")
    return NAMES[number - 1]


def in_object_frame(pose: Pose, name: str, frame: ModelFrame) -> Pose:
    """`T_camera_object`, in the frame of the box's centre, of a pose in one of the other frames.

    Args:
        pose: from the model's frame to the camera's.
        name: of the object.
        frame: of the model.

    Raises:
        UnknownName: if it is not known where the box's centre lies in that frame.
    """
    if frame == "bop":  # whatever the object
        return pose
    shifts = _SHIFTS_MM[frame]
    if name not in shifts:
        raise UnknownName(f"object of known origin in the frame {frame}", name, shifts)
    return Pose(pose.apply(1e-3 * np.array(shifts[name])), pose.quaternion)
