"""Visitors with a browser made of air, and a renderer that answers when told to."""

from concurrent.futures import Future
from types import SimpleNamespace

import numpy as np
import pytest

from app.processes.messages.neural_messages import DrawnView
from app.processes.process_client import ProcessUnavailable
from app.viewer.panels.neural_panel import NeuralPanel
from osfcore.geometry.cameras import Camera
from osfcore.geometry.light import Light
from osfcore.geometry.poses import Pose
from osfcore.geometry.states import SceneState
from tests.app.conftest import until

A, B = "003_cracker_box", "006_mustard_bottle"


class Node:
    """Any handle of viser."""

    def __init__(self, **properties):
        self.__dict__.update(properties)
        self.is_removed = False

    def on_update(self, callback):
        self.update = callback

    def remove(self):
        self.is_removed = True


class Browser:
    """A client of viser."""

    client_id = 7

    def __init__(self):
        eye = Camera.look_at("eye", (0.9, -0.9, 0.9), (0, 0, 0)).T_world_camera
        self.camera = Node(position=eye.position, wxyz=eye.quaternion, fov=0.8, aspect=1.5, image_height=600)
        self.scene = SimpleNamespace(
            set_background_image=self._show, add_frame=self._hide, get_handle_by_name=self._own
        )
        self.notifications, self.pictures, self.hidden = [], [], {}

    def _show(self, image, format="auto", *, jpeg_quality=None, depth=None):
        self.pictures.append((image, depth))

    def _hide(self, path, *, show_axes, visible):
        assert not show_axes
        assert not visible
        self.hidden[path] = Node()
        return self.hidden[path]

    def _own(self, path):
        node = self.hidden.get(path)
        return None if node is None or node.is_removed else node

    def add_notification(self, title, body, **_):
        self.notifications.append(Node(title=title, body=body))
        return self.notifications[-1]

    def hides(self):
        return {path for path, node in self.hidden.items() if not node.is_removed}


class Renderer:
    """A link that keeps orders until they are answered."""

    is_warm = True

    def __init__(self):
        self.orders = []

    def submit(self, order):
        self.orders.append((order, Future()))
        return self.orders[-1][1]

    def answer(self, number, outcome=None):
        until(lambda: len(self.orders) > number)
        order, future = self.orders[number]
        if isinstance(outcome, Exception):
            future.set_exception(outcome)
        else:
            shape = (order.camera.height, order.camera.width)
            depth = np.zeros(shape, np.float32) if order.is_sharp else None
            future.set_result(DrawnView(np.full((*shape, 3), number, np.uint8), depth))
        return order


class Room:
    """A scene, of whose objects some have fields."""

    def __init__(self):
        self.fields = {A, B}
        self.light = Light(np.array([0, 0, 1.0]))
        self.renderer = Renderer()
        self.panel = NeuralPanel(self.renderer, lambda _: (self.state(), ""), lambda: self.fields, "the {}".format)

    def state(self):
        poses = Pose(np.array([[0, 0, 0.1], [0.1, 0, 0.1]]), np.array([[1.0, 0, 0, 0]] * 2))
        return SceneState((A, B), poses, self.light, np.zeros(3))


@pytest.fixture
def room():
    room = Room()
    room.panel.start(None)
    yield room
    room.panel.close()
    room.panel.close()


@pytest.fixture
def browser(room):
    browser = Browser()
    room.panel.add_client(browser)
    return browser


def test_pictures_get_sharper_and_replace_the_meshes_until_switched_off(room, browser):
    room.panel.scene_moved()
    assert room.renderer.orders == []  # nobody asked
    room.panel.switch(browser.client_id, is_on=True)
    orders = [room.renderer.answer(number) for number in range(3)]
    assert [order.camera.height for order in orders] == [112, 256, 480]
    assert [order.is_sharp for order in orders] == [False, True, True]
    assert {order.key for order in orders} == {"view-7"}
    until(lambda: len(browser.pictures) == 3)
    assert browser.hides() == {"/table", "/pusher", "/shadows", f"/objects/{A}", f"/objects/{B}"}
    image, depth = browser.pictures[-1]
    assert image.shape == (480, 720, 3)
    assert (depth == 100).all()  # a picture of nothing hides nothing
    assert browser.pictures[0][1] is None
    room.panel.switch(browser.client_id, is_on=False)
    until(lambda: browser.pictures[-1][0] is None)
    assert browser.hides() == set()
    assert len(room.renderer.orders) == 3


def test_meshes_stay_until_the_first_picture(room, browser):
    room.renderer.is_warm = False
    room.panel.switch(browser.client_id, is_on=True)
    until(lambda: browser.notifications)
    assert "loading" in browser.notifications[0].body
    assert browser.hides() == set()
    room.renderer.answer(0)
    until(browser.hides)
    until(lambda: browser.notifications[0].is_removed)


def test_the_light_and_the_view_are_followed(room, browser):
    room.panel.switch(browser.client_id, is_on=True)
    room.renderer.answer(0)
    room.light = Light(np.array([1.0, 0, 0.5]))
    room.panel.scene_moved()
    order = room.renderer.answer(1)
    np.testing.assert_allclose(order.state.light.direction, room.light.direction, atol=1e-12)
    assert not order.is_sharp
    browser.camera.position = np.array([0.0, 0, 2.0])
    browser.camera.update(None)
    order = room.renderer.answer(2)
    np.testing.assert_allclose(order.camera.T_world_camera.position, [0, 0, 2], atol=1e-12)


def test_objects_without_a_field_stay_meshes_and_are_named(room, browser):
    room.fields = {B}
    room.panel.switch(browser.client_id, is_on=True)
    order = room.renderer.answer(0)
    assert order.state.names == (B,)
    np.testing.assert_allclose(order.state.poses.position, [[0.1, 0, 0.1]], atol=1e-12)
    until(lambda: browser.hides() == {"/table", "/pusher", "/shadows", f"/objects/{B}"})
    assert f"the {A}" in browser.notifications[0].body
    room.fields = {A, B}  # it was trained meanwhile
    room.panel.scene_moved()
    room.renderer.answer(1)
    until(lambda: f"/objects/{A}" in browser.hides())


def test_where_the_renderer_fails_the_switch_goes_back_and_says_why(room, browser):
    room.panel.switch(browser.client_id, is_on=True)
    room.renderer.answer(0, ProcessUnavailable("neural renderer", "stopped unexpectedly"))
    until(lambda: browser.notifications)
    assert "stopped unexpectedly" in browser.notifications[0].body
    assert browser.hides() == set()
    room.panel.scene_moved()
    assert len(room.renderer.orders) == 1  # it is off


def test_a_view_that_makes_no_sense_is_left_alone_until_it_does(room, browser):
    browser.camera.aspect = float("nan")
    room.panel.switch(browser.client_id, is_on=True)
    browser.camera.update(None)
    assert room.renderer.orders == []
    browser.camera.aspect = 1.0
    browser.camera.update(None)
    room.renderer.answer(0)
    until(browser.hides)


def test_who_left_gets_no_more_pictures(room, browser):
    room.panel.switch(browser.client_id, is_on=True)
    until(lambda: room.renderer.orders)
    room.panel.remove_client(browser)
    room.renderer.answer(0)
    other = Browser()
    room.panel.add_client(other)
    room.panel.switch(other.client_id, is_on=True)
    room.renderer.answer(1)
    until(lambda: other.pictures)
    assert browser.pictures == []
