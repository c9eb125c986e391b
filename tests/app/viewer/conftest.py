"""A driver that stands for a browser, and the scene of two objects that a running service shows."""

import asyncio
import contextlib
import io
from types import SimpleNamespace

import numpy as np
import pytest

from app.viewer.nodes.room import AT
from app.viewer.private_server import PrivateViser
from tests.app.conftest import until

BOX, BOTTLE = "003_cracker_box", "006_mustard_bottle"
CAMERA = {
    "type": "ViewerCameraMessage", "wxyz": [1.0, 0.0, 0.0, 0.0], "position": [1.0, 1.0, 1.0], "fov": 0.8, "near": 0.01,
    "far": 10.0, "image_height": 100, "image_width": 100, "look_at": [0.0, 0.0, 0.0], "up_direction": [0.0, 0.0, 1.0],
}  # fmt: skip


def uuid_of(element):
    """By which a browser's messages name an element."""
    return element._impl.uuid


class ViewerDriver:
    """What a browser shows of a viser server, and what people do in it.

    viser can neither list its nodes nor act as a browser, so its private state is read here, and only here.

    Args:
        server: whose scene is driven.
        client: who acts, as callbacks are told.
    """

    def __init__(self, server, client=None):
        self.server, self.client = server, client

    def drag(self, path, position=None, turn=None, *phases):
        """Move the handles of a node."""
        handles = self.node(path)
        for phase in phases or ("start", "update", "end"):
            if phase != "start":  # a hand takes hold of them before it moves them
                handles.position = np.array(handles.position if position is None else position, float)
                handles.wxyz = np.array(handles.wxyz if turn is None else turn, float)
            for callback in handles._impl_aux.update_cb:
                asyncio.run(callback(SimpleNamespace(client=self.client, target=handles, phase=phase)))

    def drag_body(self, path, eye, grip, to, *phases):
        """Take hold of a node itself where it is seen from an eye, and let it go elsewhere."""
        someone = SimpleNamespace(add_notification=lambda *_, **__: None)
        client = self.client if isinstance(self.client, SimpleNamespace) else someone
        client.camera = SimpleNamespace(position=eye)
        node = self.node(path)
        for phase in phases or ("start", "update", "end"):
            end = grip if phase == "start" else to
            event = SimpleNamespace(client=client, target=node, phase=phase, start_position=grip, end_position=end)
            for entry in node._impl.drag_cb:
                asyncio.run(entry.callback(event))

    def is_draggable(self, path):
        """Whether a hand can take hold of a node itself."""
        return bool(self.node(path)._impl.drag_cb)

    def node(self, path):
        """A node of the scene; None if there is none."""
        return self.server.scene.get_handle_by_name(path)

    def below(self, path):
        """Names of the nodes right below one."""
        parents = [name.rpartition("/") for name in list(self.server.scene._handle_from_node_name)]
        return {name for parent, _, name in parents if parent == path}

    def shows(self, path):
        """Whether a node is there and neither it nor one above it is hidden."""
        parts = path.split("/")
        above = [self.node("/".join(parts[:count])) for count in range(2, len(parts))]
        node = self.node(path)
        return node is not None and all(each.visible for each in (*above, node) if each is not None)

    def table_agrees(self, scene):
        """Whether everything on the table is where a scene of the REST interface says."""
        objects = {o["name"]: o for o in scene["objects"]}
        light = scene["light"]["position"]
        places = {"/pusher": scene["pusher"]["position"], "/light": AT * np.array(light), "/lamp": light}
        places |= {f"/objects/{name}": o["position"] for name, o in objects.items()}
        return (
            self.below("/objects") == set(objects)
            and all(np.allclose(self.node(path).position, at, atol=1e-5) for path, at in places.items())
            and all(
                np.allclose(self.node(f"/objects/{name}").wxyz, o["quaternion"], atol=1e-5)
                for name, o in objects.items()
            )
        )


@pytest.fixture(scope="session")
def viser_server():
    with contextlib.redirect_stdout(io.StringIO()):
        server = PrivateViser()
    yield server
    with contextlib.redirect_stdout(io.StringIO()):
        server.stop()


@pytest.fixture
def server(viser_server):
    """An empty viser server."""
    yield viser_server
    viser_server.gui.reset()
    viser_server.scene.reset()


@pytest.fixture
def driver(server):
    return ViewerDriver(server)


@pytest.fixture
def browser(live):
    """A driver of the running service's view."""
    return ViewerDriver(live.services.viewer.server)


@pytest.fixture
def shown(live, browser):
    _, scene = live.request("POST", "/api/scenes", {"seed": 1, "objects": [BOX, BOTTLE]})
    until(lambda: browser.table_agrees(scene))  # and so all nodes, which come first, are what they shall be
    yield scene
    live.request("DELETE", f"/api/scenes/{scene['id']}")
