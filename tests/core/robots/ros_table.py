"""A stand-in for rosbridge whose robot pushes things on a simulated table, and sees them."""

import base64
import threading

import cv2
import numpy as np

from osfcore.estimation.camera_response import srgb_of_linear
from osfcore.geometry.poses import Pose
from osfcore.geometry.workspace import STEP_S
from osfcore.io.image_file import to_uint8
from tests.core.robots import ros_stand_in
from tests.core.robots.ros_stand_in import T_BASE_TABLE, StandIn, transform

_MOVES_S, _HALF_PIXEL = 0.05, np.array([[0, 0, 0.5], [0, 0, 0.5], [0, 0, 0]])
QUERY = "cameras=north,east,south,west"


class TableStandIn(StandIn):
    """As `StandIn`, with the cameras of a table, called north, east, south, west."""

    def __init__(self, table):
        super().__init__()
        self.table, self._using = table, threading.RLock()
        names = QUERY.partition("=")[2].split(",")
        self.cameras = dict(zip(names, table.cameras, strict=True))
        self._told = self._seen = None
        self._look()

    def messages(self):
        told = {f"/{name}/image_raw/compressed": {"format": "jpeg", "data": data} for name, data in self._seen.items()}
        for name, camera in self.cameras.items():
            told[f"/{name}/camera_info"] = {
                "header": {"frame_id": f"{name}_optical"}, "width": camera.width, "height": camera.height,
                "d": [0.0] * 5, "k": (camera.intrinsics - _HALF_PIXEL).ravel().tolist(),
            }  # fmt: skip
        static = [transform("base", "table", T_BASE_TABLE)]
        static += [transform("base", f"{n}_optical", T_BASE_TABLE @ c.T_world_camera) for n, c in self.cameras.items()]
        told["/tf_static"] = {"transforms": static}
        pusher = Pose(self.pusher, np.array([1.0, 0, 0, 0]))
        return told | {"/tf": {"transforms": [transform("table", "pusher", pusher)]}}

    def load(self, state):
        """Let the table be as it is not."""
        with self._using:
            self.table.load(state)
            self._look()

    def control(self):
        """Move the table's pusher as the last twist says, for a while only."""
        while not self._ends.wait(_MOVES_S):
            if ros_stand_in.time.monotonic() - self.last_twist > ros_stand_in.DEADMAN_S:
                self.velocity = np.zeros(2)
            if self.velocity.any():
                with self._using:
                    self.table.act(np.array([*self.velocity, 0.0]) * _MOVES_S / STEP_S)
                    self._look()

    def _look(self):
        self.pusher = self.table.truth().pusher
        seen = self.table.render(tuple(self.cameras.values())).images
        bgr = [to_uint8(srgb_of_linear(image))[..., ::-1] for image in seen]
        jpegs = [cv2.imencode(".jpg", each, [cv2.IMWRITE_JPEG_QUALITY, 95])[1].tobytes() for each in bgr]
        self._seen = dict(zip(self.cameras, (base64.b64encode(each).decode() for each in jpegs), strict=True))
