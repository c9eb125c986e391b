"""Stand-ins for rosbridge with a robot behind it: JSON over a websocket."""

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

from osfcore.estimation.camera_response import srgb_of_linear
from osfcore.geometry.cameras import Camera
from osfcore.geometry.poses import Pose
from osfcore.geometry.workspace import PUSHER_CENTRE_Z_M, STEP_S
from osfcore.io.image_file import to_uint8

SIDE, EVERY_S, DEADMAN_S = 64, 0.02, 0.15
CAMERAS = {
    name: Camera.look_at(name, place, (0, 0, 0.04), size=SIDE)
    for name, place in (("left", (0, 0.65, 0.55)), ("right", (0, -0.65, 0.55)))
}
TABLE_CAMERAS = ("north", "east", "south", "west")
QUERY = f"cameras={','.join(TABLE_CAMERAS)}"
T_BASE_TABLE = Pose(np.array([0.4, 0.1, 0.02]), np.array([np.cos(0.3), 0, 0, np.sin(0.3)]))
_HALF_PIXEL = np.array([[0, 0, 0.5], [0, 0, 0.5], [0, 0, 0]])
_MOVES_S = 0.01


def transform(parent, child, pose):
    (x, y, z), (w, i, j, k) = pose.position.tolist(), pose.quaternion.tolist()
    moved = {"translation": {"x": x, "y": y, "z": z}, "rotation": {"x": i, "y": j, "z": k, "w": w}}
    return {"header": {"frame_id": parent}, "child_frame_id": child, "transform": moved}


def jpeg(image):
    return base64.b64encode(cv2.imencode(".jpg", image, [cv2.IMWRITE_JPEG_QUALITY, 95])[1].tobytes()).decode()


class StandIn:
    """A point that moves before plain pictures; it halts where no twist has come for some time."""

    def __init__(self, cameras=CAMERAS):
        self.cameras, self.velocity = cameras, np.zeros(2)
        self.pusher = np.array([0.0, 0.0, PUSHER_CENTRE_Z_M])
        self.pictures = dict.fromkeys(cameras, jpeg(np.full((SIDE, SIDE, 3), 100, np.uint8)))
        self.twists, self.frames, self.silent = [], [], set()
        self._commands, self._coming = [(time.monotonic(), np.zeros(2))], threading.Lock()
        self._moved_until, self._using = time.monotonic(), threading.RLock()
        self.extra, self.noise = {}, []
        self._ends = threading.Event()
        self._sockets = []

    def messages(self):
        """By topic, what is published now: the pusher where it is by now, however late its own thread is."""
        self._catch_up()
        published, static = {}, [transform("base", "table", T_BASE_TABLE)]
        for name, camera in self.cameras.items():
            published[f"/{name}/image_raw/compressed"] = {"format": "jpeg", "data": self.pictures[name]}
            published[f"/{name}/camera_info"] = {
                "header": {"frame_id": f"{name}_optical"}, "width": camera.width, "height": camera.height,
                "d": [0.0] * 5, "k": (camera.intrinsics - _HALF_PIXEL).ravel().tolist(),
            }  # fmt: skip
            static.append(transform("base", f"{name}_optical", T_BASE_TABLE @ camera.T_world_camera))
        pusher = Pose(self.pusher, np.array([1.0, 0, 0, 0]))
        published |= {
            "/tf_static": {"transforms": static},
            "/tf": {"transforms": [transform("/table", "pusher", pusher)]},
        }
        return {topic: message for topic, message in (published | self.extra).items() if topic not in self.silent}

    def cut(self):
        """Break all connections."""
        for one in self._sockets:
            one.socket.shutdown(socket.SHUT_RDWR)

    def handle(self, connection):
        self._sockets.append(connection)
        asked = set()
        speaker = threading.Thread(target=self._speak, args=(connection, asked))
        speaker.start()
        with contextlib.suppress(ConnectionClosed, OSError):
            for text in connection:
                message = json.loads(text)
                if message["op"] == "subscribe":
                    asked.add(message["topic"])
                elif message["op"] == "publish":
                    self._take(message["msg"])
        self._sockets.remove(connection)
        speaker.join()

    def _take(self, message):
        linear = message["twist"]["linear"]
        velocity = np.array([linear["x"], linear["y"]])
        with self._coming:
            self._commands.append((time.monotonic(), velocity))
            self.velocity = velocity
        self.twists.append(velocity)
        self.frames.append(message["header"]["frame_id"])

    def _speak(self, connection, asked):
        once = set()
        with contextlib.suppress(ConnectionClosed, OSError):
            for text in self.noise:
                connection.send(text)
            while connection in self._sockets and not self._ends.is_set():
                for topic, message in self.messages().items():
                    if topic in asked and topic not in once:
                        connection.send(json.dumps({"op": "publish", "topic": topic, "msg": message}))
                        if topic == "/tf_static":
                            once.add(topic)
                self._ends.wait(EVERY_S)

    def control(self):
        """Move the pusher as twists say, until the end."""
        while not self._ends.wait(_MOVES_S):
            self._catch_up()

    def _catch_up(self):
        with self._using:
            for velocity, seconds in self._motions():
                self.pusher = self.pusher + seconds * np.array([*velocity, 0.0])

    def _motions(self):
        """What twists have asked for since the last call, by when they came: no delay of this thread changes it."""
        motions = []
        with self._coming:
            now = time.monotonic()
            ends = [at for at, _ in self._commands[1:]] + [now]
            for (begin, velocity), end in zip(self._commands, ends, strict=True):
                seconds = min(end, begin + DEADMAN_S) - max(begin, self._moved_until)
                if velocity.any() and seconds > 0:  # else a test may have put the pusher elsewhere
                    motions.append((velocity, seconds))
            self._commands, self._moved_until = self._commands[-1:], now
            if now - self._commands[0][0] > DEADMAN_S:
                self.velocity = np.zeros(2)
        return motions

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


class TableStandIn(StandIn):
    """A robot that pushes things on a simulated table, and sees them with four cameras."""

    def __init__(self, table):
        super().__init__(dict(zip(TABLE_CAMERAS, table.cameras, strict=True)))
        self.table = table
        self._look()

    def load(self, state):
        """Change the table's state."""
        with self._using:
            self.table.load(state)
            self._look()

    def _catch_up(self):
        with self._using:
            motions = self._motions()
            for velocity, seconds in motions:
                self.table.act(np.array([*velocity, 0.0]) * seconds / STEP_S)
            if motions:
                self._look()

    def _look(self):
        self.pusher = self.table.truth().pusher
        seen = self.table.render(tuple(self.cameras.values())).images
        encoded = [jpeg(to_uint8(srgb_of_linear(image))[..., ::-1]) for image in seen]
        self.pictures = dict(zip(self.cameras, encoded, strict=True))
