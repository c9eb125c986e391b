"""Where a plan leads: what moves is drawn on its way, at its end, and going there."""

from dataclasses import replace

import numpy as np
import pytest

from app.viewer.nodes.future_nodes import ON_THE_WAY, FutureNodes, on_the_way
from osfcore.geometry.poses import Pose, quaternion_exp
from tests.app.viewer.nodes.test_episode_nodes import BOX, CAN, TURNS, sketch


@pytest.fixture
def drawing(server, library):
    return FutureNodes(server.scene, library, "/future", (190, 50, 210))


def test_what_moves_is_drawn_at_its_end_paler_on_the_way_and_once_more_where_it_begins(drawing):
    drawing.show(sketch().best)
    box, can = drawing.ghosts[BOX], drawing.ghosts[CAN]
    assert box.visible
    assert not can.visible  # it stays
    x = box.batched_positions[:, 0]
    assert len(x) == ON_THE_WAY + 2
    assert np.all(np.diff(x[:-1]) > 0)
    assert x[0] > 0.01
    np.testing.assert_allclose(x[-2:], [0.1, 0.0], atol=1e-6)
    assert np.all(box.batched_opacities[:ON_THE_WAY] < box.batched_opacities[-1])
    drawing.show(sketch(goes_m=0.0).best)
    assert drawing.ghosts[BOX] is box
    assert not box.visible
    drawing.show(None)
    assert not any(node.visible for node in drawing.nodes)


def test_one_copy_and_the_pusher_go_along_and_the_others_stay(drawing, driver):
    drawing.at(2.0)  # nothing is shown yet
    assert drawing.steps == 0
    drawing.show(sketch(moments=11).best)
    assert drawing.steps == 10
    before = drawing.ghosts[BOX].batched_positions.copy()
    for step, x in ((5.0, 0.05), (7.5, 0.075), (10.0, 0.1), (99.0, 0.1)):
        drawing.at(step)
        after = drawing.ghosts[BOX].batched_positions
        np.testing.assert_allclose(after[:-1], before[:-1], atol=1e-12)
        assert after[-1, 0] == pytest.approx(x)
        assert driver.node("/future/pusher").position[0] == pytest.approx(2 * x - 0.2)


def test_another_scene_has_other_ghosts(drawing, driver):
    drawing.show(sketch().best)
    drawing.show(replace(sketch().best, names=("004_sugar_box", CAN)))
    assert driver.node(f"/future/{BOX}") is None
    assert set(drawing.ghosts) == {"004_sugar_box", CAN}


def test_ghosts_on_the_way_are_spread_over_the_way_and_not_over_the_wait():
    x = 0.02 * np.maximum(np.arange(11) - 6, 0)
    waits = Pose(np.stack([x, 0 * x, 0 * x], axis=1), np.tile(TURNS[0], (11, 1)))
    rows = on_the_way(waits, 3)
    assert rows == sorted(rows)
    assert x[rows].min() > 0.01
    angles = np.linspace(0, 1, 11)
    turns = Pose(np.zeros((11, 3)), quaternion_exp(angles[:, None] * np.array([0, 0, 1.0])))
    np.testing.assert_allclose(angles[on_the_way(turns, 3)], [0.25, 0.5, 0.75], atol=0.1)
    assert on_the_way(waits[:2], 3) == [1, 1, 1]
