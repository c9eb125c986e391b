import contextlib
import io

import numpy as np
import pytest

from app.viewer.nodes.estimate_nodes import GHOSTS, EstimateDrawing
from app.viewer.viewer import LoopbackViser
from osfcore.estimation.steps import EstimateStep
from osfcore.geometry.estimated_state import EstimatedState
from osfcore.geometry.light import Light
from osfcore.geometry.poses import Pose
from osfcore.geometry.states import SceneState
from osfcore.progress import Progress

BOX, UNKNOWN = "003_cracker_box", "055_baseball"  # the second has no mesh here
LIGHT = Light(np.array([0.6, 0, 0.8]))
UPRIGHT = np.array([1.0, 0, 0, 0])


@pytest.fixture(scope="module")
def server():
    with contextlib.redirect_stdout(io.StringIO()):
        server = LoopbackViser(host="127.0.0.1", port=0, verbose=False)
    yield server
    with contextlib.redirect_stdout(io.StringIO()):
        server.stop()


@pytest.fixture
def drawing(server, library):
    drawing = EstimateDrawing(server, library)
    yield drawing
    drawing.clear()


def state(names=(BOX, UNKNOWN), z=0.1):
    count = len(names)
    return SceneState(names, Pose(np.tile([0.1, -0.05, z], (count, 1)), np.tile(UPRIGHT, (count, 1))), LIGHT, None)


def tried(count, names=2):
    rng = np.random.default_rng(0)
    turns = rng.normal(size=(count, names, 4))
    return Pose(rng.normal(size=(count, names, 3)), turns / np.linalg.norm(turns, axis=-1, keepdims=True))


def step(guess=None, candidates=None, lights=None, estimate=None):
    return EstimateStep(Progress(1, 2, ""), "objects", guess or state(), candidates, lights, estimate=estimate)


def judged(doubt="", position=0.001, turn=0.02):
    doubts = (doubt, "")
    return EstimatedState(state(), np.full(2, position), np.full(2, turn), 0.01, doubts, doubt)


def nodes(drawing, kind):
    return [node for node in drawing._verdicts if node.name.endswith(kind)]


@pytest.mark.parametrize("count", [3, 24, 50])
def test_candidates_of_each_object_are_drawn_where_they_were_tried_up_to_a_number(drawing, count):
    candidates = tried(count)
    drawing.show(step(candidates=candidates))
    for n, name in enumerate((BOX, UNKNOWN)):
        node = drawing._tried[name]
        assert node.visible
        assert node.batched_positions.shape == (GHOSTS, 3)
        own = candidates.position[:, n].astype(np.float32)
        assert {tuple(p) for p in node.batched_positions} <= {tuple(p) for p in own}
        assert len(np.unique(node.batched_positions, axis=0)) == min(count, GHOSTS)
    drawing.show(step())
    assert not drawing._tried[BOX].visible


def test_the_guess_and_its_light_follow_and_what_was_not_looked_for_is_hidden(drawing):
    drawing.show(step(state(z=-1.0)))
    assert not drawing._guesses[BOX].visible
    drawing.show(step())
    assert drawing._guesses[BOX].visible
    np.testing.assert_allclose(drawing._guesses[BOX].batched_positions, [[0.1, -0.05, 0.1]], rtol=1e-6)
    cube, _, label = drawing._lamp
    np.testing.assert_allclose(cube.position, LIGHT.position)
    np.testing.assert_allclose(label.position, LIGHT.position)
    assert label.text == "guessed light"


def test_lights_that_are_tried_are_drawn_while_there_are_any(drawing):
    lights = np.array([[0, 0, 1.0], [0.6, 0, 0.8]])
    drawing.show(step(lights=lights))
    assert drawing._tried_lights.visible
    assert {tuple(p) for p in drawing._tried_lights.batched_positions} == {tuple(p) for p in lights.astype(np.float32)}
    drawing.show(step())
    assert not drawing._tried_lights.visible


def test_meshes_are_sent_once(drawing):
    drawing.show(step())
    before = drawing._guesses[BOX]
    drawing.show(step(candidates=tried(5)))
    assert drawing._guesses[BOX] is before
    drawing.show(step(state((BOX,))))
    assert set(drawing._guesses) == {BOX}
    assert before._impl.removed


@pytest.mark.parametrize(("position", "turn"), [(0.01, 0.3), (1e-6, 1e-6), (np.inf, np.inf)])
def test_uncertainty_is_two_deviations_but_never_too_small_or_too_large_to_see(drawing, position, turn):
    drawing.show(step(estimate=judged(position=position, turn=turn)))
    balls, sectors, words = (nodes(drawing, kind) for kind in ("position", "turn", "words"))
    assert len(balls) == len(sectors) == len(words) == 2
    assert balls[0].radius == pytest.approx(np.clip(2 * position, 0.006, 0.1))
    half = np.clip(2 * turn, 0.06, np.pi)
    rim = sectors[0].vertices
    steps = np.diff(np.unwrap(np.arctan2(rim[:25, 1], rim[:25, 0])))
    assert steps.sum() == pytest.approx(2 * half, rel=1e-3)
    size = drawing._library.size_m(BOX)
    assert balls[0].position[2] == pytest.approx(0.1 + size[2] / 2, abs=0.02)  # on top, where it shows
    assert ("any" in words[0].text) == np.isinf(position)


def test_doubted_objects_are_drawn_in_another_colour_with_the_reason(drawing):
    drawing.show(step(estimate=judged("it is hardly visible")))
    doubted, trusted = drawing._guesses[BOX].batched_colors, drawing._guesses[UNKNOWN].batched_colors
    assert not np.array_equal(doubted, trusted)
    texts = [node.text for node in nodes(drawing, "words")]
    assert texts[0] == "DOUBTFUL: it is hardly visible"
    assert texts[1].startswith("± 2 mm, ± 2.3")
    assert drawing._lamp[2].text == "estimated light ± 1.1°"
    drawing.show(step())  # another estimate begins: no verdict is left
    assert drawing._verdicts == []
    np.testing.assert_array_equal(drawing._guesses[BOX].batched_colors, drawing._guesses[UNKNOWN].batched_colors)


def test_what_is_not_on_the_table_is_named(server, library):
    drawing = EstimateDrawing(server, library, lambda name: name != BOX)
    drawing.show(step(estimate=judged("it is hardly visible")))
    texts = [node.text for node in nodes(drawing, "words")]
    assert texts[0] == "Cracker box: DOUBTFUL: it is hardly visible"
    assert texts[1].startswith("± 2 mm")
    drawing.clear()


def test_candidates_can_be_hidden_and_everything_removed(drawing):
    drawing.show_candidates(False)
    drawing.show(step(candidates=tried(4), lights=np.array([[0, 0, 1.0]])))
    assert not drawing._tried[BOX].visible
    assert not drawing._tried_lights.visible
    assert not drawing.is_empty
    kept = [*drawing._guesses.values(), *drawing._lamp]
    drawing.clear()
    assert drawing.is_empty
    assert all(node._impl.removed for node in kept)
    drawing.show_candidates(True)


def test_estimates_of_things_on_their_way_are_drawn_without_a_word(drawing):
    drawing.show(step(candidates=tried(5), estimate=judged()))
    before = drawing._guesses[BOX]
    drawing.follow(judged("it is hardly visible"))
    assert drawing._guesses[BOX] is before
    assert drawing._verdicts == []
    assert not drawing._tried[BOX].visible
    assert not np.array_equal(before.batched_colors, drawing._guesses[UNKNOWN].batched_colors)
    assert drawing._lamp[2].text == "estimated light"


def test_another_drawing_has_its_own_nodes_and_colour_and_may_do_without_light(server, library):
    drawing = EstimateDrawing(server, library, root="/elsewhere", colour=(1, 2, 3), has_light=False)
    drawing.show(step(candidates=tried(4), lights=np.array([[0, 0, 1.0]]), estimate=judged()))
    nodes_of = [*drawing._tried.values(), *drawing._guesses.values(), *drawing._verdicts, drawing._tried_lights]
    assert all(node.name.startswith("/elsewhere/") for node in nodes_of)
    assert drawing._lamp is None
    assert not drawing._tried_lights.visible
    drawing.show(step())
    assert tuple(drawing._guesses[BOX].batched_colors) == (1, 2, 3)
    drawing.clear()
    assert drawing.is_empty
