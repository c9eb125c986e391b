"""Neural pictures in the 3D view: visitors with a browser made of air, and a renderer that answers when it is to."""

from concurrent.futures import Future
from types import SimpleNamespace

import numpy as np
import pytest

from app.processes.client import ProcessUnavailable
from app.processes.messages.neural_messages import DrawnView
from app.viewer.neural_panel import REST_S, STEPS, HiddenNodes, NeuralPanel, Refinement
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
        self.panel = NeuralPanel(self.renderer, lambda: self.fields, "the {}".format)

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
    browser.view = room.panel.add(browser, lambda: (room.state(), ""))
    return browser


def test_pictures_get_sharper_and_replace_the_meshes_until_switched_off(room, browser):
    room.panel.moved()
    assert room.renderer.orders == []  # nobody asked
    room.panel.switch(browser.view, is_on=True)
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
    room.panel.switch(browser.view, is_on=False)
    until(lambda: browser.pictures[-1][0] is None)
    assert browser.hides() == set()
    assert len(room.renderer.orders) == 3


def test_meshes_stay_until_the_first_picture(room, browser):
    room.renderer.is_warm = False
    room.panel.switch(browser.view, is_on=True)
    until(lambda: browser.notifications)
    assert "loading" in browser.notifications[0].body
    assert browser.hides() == set()
    room.renderer.answer(0)
    until(browser.hides)
    until(lambda: browser.notifications[0].is_removed)


def test_the_light_and_the_view_are_followed(room, browser):
    room.panel.switch(browser.view, is_on=True)
    room.renderer.answer(0)
    room.light = Light(np.array([1.0, 0, 0.5]))
    room.panel.moved()
    order = room.renderer.answer(1)
    np.testing.assert_allclose(order.state.light.direction, room.light.direction, atol=1e-12)
    assert not order.is_sharp
    browser.camera.position = np.array([0.0, 0, 2.0])
    browser.camera.update(None)
    order = room.renderer.answer(2)
    np.testing.assert_allclose(order.camera.T_world_camera.position, [0, 0, 2], atol=1e-12)


def test_objects_without_a_field_stay_meshes_and_are_named(room, browser):
    room.fields = {B}
    room.panel.switch(browser.view, is_on=True)
    order = room.renderer.answer(0)
    assert order.state.names == (B,)
    np.testing.assert_allclose(order.state.poses.position, [[0.1, 0, 0.1]], atol=1e-12)
    until(lambda: browser.hides() == {"/table", "/pusher", "/shadows", f"/objects/{B}"})
    assert f"the {A}" in browser.notifications[0].body
    room.fields = {A, B}  # it was trained meanwhile
    room.panel.moved()
    room.renderer.answer(1)
    until(lambda: f"/objects/{A}" in browser.hides())


def test_where_the_renderer_fails_the_switch_goes_back_and_says_why(room, browser):
    room.panel.switch(browser.view, is_on=True)
    room.renderer.answer(0, ProcessUnavailable("neural renderer", "stopped unexpectedly"))
    until(lambda: browser.notifications)
    assert "stopped unexpectedly" in browser.notifications[0].body
    assert browser.hides() == set()
    room.panel.moved()
    assert len(room.renderer.orders) == 1  # it is off


def test_a_view_that_makes_no_sense_is_left_alone_until_it_does(room, browser):
    browser.camera.aspect = float("nan")
    room.panel.switch(browser.view, is_on=True)
    browser.camera.update(None)
    assert room.renderer.orders == []
    browser.camera.aspect = 1.0
    browser.camera.update(None)
    room.renderer.answer(0)
    until(browser.hides)


def test_who_left_gets_no_more_pictures(room, browser):
    room.panel.switch(browser.view, is_on=True)
    until(lambda: room.renderer.orders)
    room.panel.remove(browser.view)
    room.renderer.answer(0)
    other = Browser()
    room.panel.switch(room.panel.add(other, lambda: (room.state(), "")), is_on=True)
    room.renderer.answer(1)
    until(lambda: other.pictures)
    assert browser.pictures == []


@pytest.fixture
def view():
    refinement = Refinement()
    refinement.moved(10.0)
    return refinement


def test_steps_grow_sharper():
    assert [step.is_sharp for step in STEPS] == [False, True, True]
    assert [step.rows for step in STEPS] == sorted(step.rows for step in STEPS)
    assert 96 <= STEPS[0].rows <= 128
    assert 360 <= STEPS[-1].rows <= 480


def test_coarse_at_once_then_sharper_after_a_rest(view):
    assert view.due_at() == 10.0
    ticket = view.order()
    assert view.due_at() is None
    assert view.accept(ticket, is_there=True)
    for step in (1, 2):
        assert view.due_at() == 10.0 + REST_S
        ticket = view.order()
        assert ticket.step == step
        assert view.due_at() is None
        assert view.accept(ticket, is_there=True)
    assert view.due_at() is None
    view.moved(20.0)
    assert view.due_at() == 20.0


def test_while_things_move_one_coarse_picture_after_the_other_is_shown(view):
    for number in range(5):
        ticket = view.order()
        view.moved(11.0 + number)
        assert view.due_at() is None  # one at a time
        assert view.accept(ticket, is_there=True)
        assert view.due_at() == 11.0 + number
        assert view.order().step == 0
        view.accept(view.order(), is_there=False)


def test_a_sharp_picture_of_the_past_is_neither_waited_for_nor_shown(view):
    view.accept(view.order(), is_there=True)
    sharp = view.order()
    assert sharp.step == 1
    view.moved(12.0)
    assert view.due_at() == 12.0
    coarse = view.order()
    assert not view.accept(sharp, is_there=False)
    assert not view.accept(sharp, is_there=True)
    assert view.due_at() is None  # the coarse one still comes
    assert view.accept(coarse, is_there=True)


def test_a_sharp_picture_that_comes_after_a_movement_is_not_shown(view):
    view.accept(view.order(), is_there=True)
    sharp = view.order()
    view.moved(12.0)
    assert not view.accept(sharp, is_there=True)
    assert view.due_at() == 12.0


def test_what_did_not_come_is_ordered_again(view):
    assert not view.accept(view.order(), is_there=False)
    assert view.due_at() == 10.0


def test_where_no_picture_can_be_made_nothing_is_due_before_a_movement(view):
    view.give_up(view.order())
    assert view.due_at() is None
    view.moved(13.0)
    assert view.due_at() == 13.0


@pytest.fixture
def visitor():
    return Browser()


def test_a_node_is_hidden_until_nobody_wants_that(visitor):
    hidden = HiddenNodes(visitor)
    hidden.hide("a", {"/x", "/y"})
    hidden.hide("b", {"/y"})
    assert visitor.hides() == {"/x", "/y"}
    hidden.hide("a", ())
    assert visitor.hides() == {"/y"}
    hidden.hide("b", ())
    assert visitor.hides() == set()


def test_a_node_of_the_browsers_own_stays_the_same(visitor):
    visitor.hidden["/x"] = mine = Node(visible=True)
    hidden = HiddenNodes(visitor)
    hidden.hide("a", {"/x"})
    assert visitor.hidden["/x"] is mine
    assert not mine.visible
    hidden.hide("a", ())
    assert mine.visible
    assert not mine.is_removed


def test_what_somebody_else_has_covered_meanwhile_is_left_to_them(visitor):
    hidden = HiddenNodes(visitor)
    hidden.hide("a", {"/x"})
    visitor.hidden["/x"] = other = Node(visible=False)
    hidden.hide("a", ())
    assert not other.visible
    assert not other.is_removed
