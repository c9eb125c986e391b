"""Small objects and a local web server for the mesh sources."""

import functools
import http.server
import threading
from pathlib import Path

import numpy as np
import pytest
import trimesh
from PIL import Image


def write_google_16k(root: Path, name: str, sides=(0.1, 0.06, 0.04)) -> Path:
    """A box in the layout of the YCB downloads, red at the top of its texture and green below."""
    folder = root / name / "google_16k"
    folder.mkdir(parents=True)
    box = trimesh.creation.box(sides)
    image = np.zeros((64, 64, 3), np.uint8)
    image[:32, :, 0] = image[32:, :, 1] = 200
    Image.fromarray(image).save(folder / "texture_map.jpg", quality=95)
    (folder / "textured.mtl").write_text("newmtl material_0\nmap_Kd texture_map.jpg \n")
    lines = ["mtllib textured.mtl", "usemtl material_0"]
    lines += [f"v {x} {y} {z}" for x, y, z in box.vertices]
    lines += [f"vt {0.1 + 0.1 * i} {0.9 if z > 0 else 0.1}" for i, (_, _, z) in enumerate(box.vertices)]
    lines += ["f " + " ".join(f"{i + 1}/{i + 1}" for i in face) for face in box.faces]
    (folder / "textured.obj").write_text("\n".join(lines) + "\n")
    return folder


class _Quiet(http.server.SimpleHTTPRequestHandler):
    def log_message(self, format, *args):
        self.server.seen.append(self.path)

    def send_head(self):
        mode = self.server.modes.get(self.path.rsplit("/", 1)[-1])
        if mode == "error":
            self.send_error(503)
            return None
        if mode == "short":  # promises more than it sends
            self.send_response(200)
            self.send_header("Content-Length", "1000")
            self.end_headers()
            self.wfile.write(b"abc")
            return None
        return super().send_head()


@pytest.fixture
def served(tmp_path):
    """(folder, address, server): what lies in the folder is served; `server.modes` makes single files fail."""
    root = tmp_path / "served"
    root.mkdir()
    server = http.server.ThreadingHTTPServer(("127.0.0.1", 0), functools.partial(_Quiet, directory=str(root)))
    server.modes, server.seen = {}, []
    thread = threading.Thread(target=server.serve_forever, kwargs={"poll_interval": 0.01})
    thread.start()
    yield root, f"http://127.0.0.1:{server.server_port}", server
    server.shutdown()
    thread.join()
    server.server_close()


@pytest.fixture
def make_object():
    """Writes a box in google_16k layout: `make_object(folder, name)`."""
    return write_google_16k
