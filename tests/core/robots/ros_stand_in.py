"""A stand-in for rosbridge with a robot behind it: JSON over a websocket, a point that moves, plain pictures."""

import base64
import contextlib
import json
import socket
import threading
import time

import cv2
import numpy as np
from websockets.exceptions import ConnectionClosed
from websockets.sync.server import serve

from osfcore.geometry.cameras import Camera
from osfcore.geometry.poses import Pose

SIDE, EVERY_S, DEADMAN_S = 64, 0.02, 0.15
CAMERAS = {
    name: Camera.look_at(name, place, (0, 0, 0.04), size=SIDE)
    for name, place in (("left", (0, 0.65, 0.55)), ("right", (0, -0.65, 0.55)))
}
T_BASE_TABLE = Pose(np.array([0.4, 0.1, 0.02]), np.array([np.cos(0.3), 0, 0, np.sin(0.3)]))


def transform(parent, child, pose):
    (x, y, z), (w, i, j, k) = pose.position.tolist(), pose.quaternion.tolist()
    rotation = {"x": i, "y": j, "z": k, "w": w}
    moved = {"translation": {"x": x, "y": y, "z": z}, "rotation": rotation}
    return {"header": {"frame_id": parent}, "child_frame_id": child, "transform": moved}


class StandIn:
    """What a robot under ROS would publish; a controller that halts where no twist has come for some time."""

    def __init__(self):
        self.place, self.velocity = np.zeros(2), np.zeros(2)
        self.twists, self.frames, self.silent = [], [], set()
        self.last_twist = 0.0
        self.extra = {}
        self._ends = threading.Event()
        self._sockets = []

    def messages(self):
        """By topic, what is published now."""
        told = {}
        shade = np.full((SIDE, SIDE, 3), 100, np.uint8)
        picture = base64.b64encode(cv2.imencode(".jpg", shade)[1].tobytes()).decode()
        for name, camera in CAMERAS.items():
            told[f"/{name}/image_raw/compressed"] = {"format": "jpeg", "data": picture}
            told[f"/{name}/camera_info"] = {
                "header": {"frame_id": f"{name}_optical"}, "width": SIDE, "height": SIDE, "d": [0.0] * 5,
                "k": (camera.intrinsics - [[0, 0, 0.5], [0, 0, 0.5], [0, 0, 0]]).ravel().tolist(),
            }  # fmt: skip
        static = [transform("base", "table", T_BASE_TABLE)]
        static += [transform("base", f"{n}_optical", T_BASE_TABLE @ c.T_world_camera) for n, c in CAMERAS.items()]
        told["/tf_static"] = {"transforms": static}
        pusher = Pose(np.array([*self.place, 0.06]), np.array([1.0, 0, 0, 0]))
        told["/tf"] = {"transforms": [transform("/table", "pusher", pusher)]}
        return {topic: message for topic, message in (told | self.extra).items() if topic not in self.silent}

    def cut(self):
        """Break all connections."""
        for one in self._sockets:
            one.socket.shutdown(socket.SHUT_RDWR)

    def handle(self, connection):
        self._sockets.append(connection)
        asked = {}
        speaker = threading.Thread(target=self._speak, args=(connection, asked))
        speaker.start()
        with contextlib.suppress(ConnectionClosed, OSError):
            for text in connection:
                message = json.loads(text)
                if message["op"] == "subscribe":
                    asked[message["topic"]] = message["type"]
                elif message["op"] == "publish":
                    self._take(message["msg"])
        asked.clear()
        self._sockets.remove(connection)
        speaker.join()

    def _take(self, message):
        linear = message["twist"]["linear"]
        self.velocity = np.array([linear["x"], linear["y"]])
        self.twists.append(self.velocity)
        self.frames.append(message["header"]["frame_id"])
        self.last_twist = time.monotonic()

    def _speak(self, connection, asked):
        once = set()
        with contextlib.suppress(ConnectionClosed, OSError):
            while connection in self._sockets and not self._ends.is_set():
                for topic, message in self.messages().items():
                    if topic in asked and topic not in once:
                        connection.send(json.dumps({"op": "publish", "topic": topic, "msg": message}))
                        if topic == "/tf_static":
                            once.add(topic)
                self._ends.wait(EVERY_S)

    def control(self):
        """Move the point in real time, until the end."""
        before = time.monotonic()
        while not self._ends.wait(0.005):
            now = time.monotonic()
            if now - self.last_twist > DEADMAN_S:
                self.velocity = np.zeros(2)
            self.place = self.place + (now - before) * self.velocity
            before = now

    @contextlib.contextmanager
    def running(self):
        """Its address, as `osf robot` takes it."""
        with serve(self.handle, "127.0.0.1", 0, compression=None) as server:
            threads = [threading.Thread(target=server.serve_forever), threading.Thread(target=self.control)]
            for thread in threads:
                thread.start()
            try:
                yield f"ros://127.0.0.1:{server.socket.getsockname()[1]}?cameras=left,right"
            finally:
                self._ends.set()
                server.shutdown()
                for thread in threads:
                    thread.join()
