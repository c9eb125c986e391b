import pytest

from app.viewer.nodes.hidden_nodes import HiddenNodes
from tests.app.viewer.panels.test_neural_panel import Browser, Node


@pytest.fixture
def browser():
    return Browser()


def test_a_node_is_hidden_until_nobody_wants_that(browser):
    hidden = HiddenNodes(browser)
    hidden.hide("a", {"/x", "/y"})
    hidden.hide("b", {"/y"})
    assert browser.hides() == {"/x", "/y"}
    hidden.hide("a", ())
    assert browser.hides() == {"/y"}
    hidden.hide("b", ())
    assert browser.hides() == set()


def test_a_node_of_the_browsers_own_stays_the_same(browser):
    browser.hidden["/x"] = mine = Node(visible=True)
    hidden = HiddenNodes(browser)
    hidden.hide("a", {"/x"})
    assert browser.hidden["/x"] is mine
    assert not mine.visible
    hidden.hide("a", ())
    assert mine.visible
    assert not mine.is_removed


def test_what_somebody_else_has_covered_meanwhile_is_left_to_them(browser):
    hidden = HiddenNodes(browser)
    hidden.hide("a", {"/x"})
    browser.hidden["/x"] = other = Node(visible=False)
    hidden.hide("a", ())
    assert not other.visible
    assert not other.is_removed
