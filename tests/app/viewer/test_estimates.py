"""Estimates in the 3D view: what is drawn of an estimator at work, and when."""

import numpy as np
import pytest

from app.jobs.job import Job, JobChanged, JobView
from app.processes.messages.scene_messages import SceneChanged
from app.services.event_hub import CurrentScene
from app.viewer.job_panels import EstimatePanel
from app.viewer.nodes.estimate_nodes import GHOSTS, TRACKED, EstimateNodes
from app.viewer.nodes.room import AT, LINE, VIEW_AT, VIEW_FOV_RAD, VIEW_FROM
from osfcore.estimation.steps import EstimateStep
from osfcore.geometry.cameras import Camera
from osfcore.geometry.light import Light
from osfcore.geometry.poses import Pose
from osfcore.geometry.states import EstimatedState, SceneState
from osfcore.progress import Progress
from tests.app.conftest import until
from tests.app.storage.test_database import record
from tests.app.viewer.conftest import ViewerDriver

BOX, UNKNOWN = "003_cracker_box", "055_baseball"  # the second has no mesh here
LIGHT = Light(np.array([0.6, 0, 0.8]))
UPRIGHT = np.array([1.0, 0, 0, 0])


@pytest.fixture
def drawing(server, library):
    return EstimateNodes(server, library)


def state(names=(BOX, UNKNOWN), z=0.1):
    count = len(names)
    return SceneState(names, Pose(np.tile([0.1, -0.05, z], (count, 1)), np.tile(UPRIGHT, (count, 1))), LIGHT, None)


def tried(count, names=2):
    rng = np.random.default_rng(0)
    turns = rng.normal(size=(count, names, 4))
    return Pose(rng.normal(size=(count, names, 3)), turns / np.linalg.norm(turns, axis=-1, keepdims=True))


def judged(doubt="", position=0.001, turn=0.02):
    doubts = (doubt, "")
    return EstimatedState(state(), np.full(2, position), np.full(2, turn), 0.01, doubts, doubt)


def tried_node(driver, name=BOX):
    return driver.node(f"/estimate/tried/{name}")


def guess(driver, name=BOX):
    return driver.node(f"/estimate/guess/{name}")


def verdicts(driver, kind):
    return [driver.node(f"/estimate/verdict/{name}/{kind}") for name in (BOX, UNKNOWN)]


@pytest.mark.parametrize("count", [3, 24, 50])
def test_candidates_of_each_object_are_drawn_where_they_were_tried_up_to_a_number(drawing, driver, count):
    candidates = tried(count)
    drawing.show(state(), candidates)
    for n, name in enumerate((BOX, UNKNOWN)):
        node = tried_node(driver, name)
        assert node.visible
        assert node.batched_positions.shape == (GHOSTS, 3)
        own = candidates.position[:, n].astype(np.float32)
        assert {tuple(p) for p in node.batched_positions} <= {tuple(p) for p in own}
        assert len(np.unique(node.batched_positions, axis=0)) == min(count, GHOSTS)
    drawing.show(state())
    assert not driver.shows(f"/estimate/tried/{BOX}")


def test_the_guess_and_its_light_follow_and_what_was_not_looked_for_is_hidden(drawing, driver):
    drawing.show(state(z=-1.0))
    assert not driver.shows(f"/estimate/guess/{BOX}")
    drawing.show(state())
    assert driver.shows(f"/estimate/guess/{BOX}")
    np.testing.assert_allclose(guess(driver).batched_positions, [[0.1, -0.05, 0.1]], rtol=1e-6)
    cube, label = driver.node("/estimate/light"), driver.node("/estimate/light_name")
    np.testing.assert_allclose(cube.position, AT * LIGHT.position, atol=1e-12)
    np.testing.assert_allclose(label.position, AT * LIGHT.position, atol=1e-12)
    assert label.text == "guessed light"


def test_lights_that_are_tried_are_drawn_while_there_are_any(drawing, driver):
    lights = np.array([[0, 0, 1.0], [0.6, 0, 0.8]])
    drawing.show(state(), lights=lights)
    assert driver.shows("/estimate/tried_lights")
    places = driver.node("/estimate/tried_lights").batched_positions
    assert {tuple(p) for p in places} == {tuple(p) for p in (AT * lights).astype(np.float32)}
    drawing.show(state())
    assert not driver.shows("/estimate/tried_lights")


def test_meshes_are_sent_once(drawing, driver):
    drawing.show(state())
    before = guess(driver)
    drawing.show(state(), tried(5))
    assert guess(driver) is before
    drawing.show(state((BOX,)))
    assert driver.below("/estimate/guess") == {BOX}
    assert guess(driver) is not before


@pytest.mark.parametrize(("position", "turn"), [(0.01, 0.3), (1e-6, 1e-6), (np.inf, np.inf)])
def test_uncertainty_is_two_deviations_but_never_too_small_or_too_large_to_see(
    drawing, driver, library, position, turn
):
    drawing.show(state(), estimate=judged(position=position, turn=turn))
    balls, sectors, words = (verdicts(driver, kind) for kind in ("position", "turn", "words"))
    assert balls[0].radius == pytest.approx(np.clip(2 * position, 0.006, 0.1))
    half = np.clip(2 * turn, 0.06, np.pi)
    rim = sectors[0].vertices
    steps = np.diff(np.unwrap(np.arctan2(rim[:25, 1], rim[:25, 0])))
    assert steps.sum() == pytest.approx(2 * half, rel=1e-3)
    size = library.size_m(BOX)
    assert balls[0].position[2] == pytest.approx(0.1 + size[2] / 2, abs=0.02)  # on top, where it shows
    assert ("any" in words[0].text) == np.isinf(position)


def test_doubted_objects_are_drawn_in_another_colour_with_the_reason(drawing, driver):
    drawing.show(state(), estimate=judged("it is hardly visible"))
    doubted, trusted = guess(driver).batched_colors, guess(driver, UNKNOWN).batched_colors
    assert not np.array_equal(doubted, trusted)
    texts = [node.text for node in verdicts(driver, "words")]
    assert texts[0] == "Cracker box: DOUBTFUL: it is hardly visible"
    assert "± 2 mm, ± 2.3" in texts[1]
    assert driver.node("/estimate/light_name").text == "estimated light ± 1.1° (2σ)"
    drawing.show(state())  # another estimate begins: no verdict is left
    assert driver.below(f"/estimate/verdict/{BOX}") == set()
    np.testing.assert_array_equal(guess(driver).batched_colors, guess(driver, UNKNOWN).batched_colors)


def test_words_do_not_cover_each_other(drawing, driver):
    drawing.show(state(), estimate=judged())
    view = Camera.look_at("view", VIEW_FROM, VIEW_AT, fov_y_deg=float(np.rad2deg(VIEW_FOV_RAD)))
    feet = [node.position for node in verdicts(driver, "words")]
    heights = np.sort(view.project(np.array(feet))[:, 1] / view.height)
    assert np.diff(heights).min() > 0.8 * LINE


def test_everything_can_be_removed(drawing, driver):
    drawing.show(state(), tried(4), np.array([[0, 0, 1.0]]))
    drawing.clear()
    assert not driver.shows("/estimate/tried_lights")
    assert driver.below("/estimate/guess") == driver.below("/estimate/tried") == set()
    assert driver.node("/estimate/light") is driver.node("/estimate/light_name") is None


def test_estimates_of_things_on_their_way_are_drawn_without_a_word(drawing, driver):
    drawing.show(state(), tried(5), estimate=judged())
    before = guess(driver)
    drawing.follow(state(), ("it is hardly visible", ""))
    assert guess(driver) is before
    assert driver.below(f"/estimate/verdict/{BOX}") == set()
    assert not driver.shows(f"/estimate/tried/{BOX}")
    assert not np.array_equal(before.batched_colors, guess(driver, UNKNOWN).batched_colors)
    assert driver.shows(f"/estimate/{TRACKED}/light")
    assert not driver.shows(f"/estimate/{TRACKED}/light_name")
    assert not driver.shows("/estimate/light")


def test_another_drawing_has_its_own_nodes_and_colour_and_may_do_without_light(server, driver, library):
    drawing = EstimateNodes(server, library, root="/elsewhere", colour=(1, 2, 3), has_light=False)
    drawing.show(state(), tried(4), np.array([[0, 0, 1.0]]), judged())
    assert driver.below("/elsewhere/guess") == driver.below("/elsewhere/tried") == {BOX, UNKNOWN}
    assert driver.below("/estimate") == set()
    assert driver.node("/elsewhere/light") is None
    assert not driver.shows("/elsewhere/tried_lights")
    drawing.show(state())
    assert tuple(driver.node(f"/elsewhere/guess/{BOX}").batched_colors) == (1, 2, 3)
    drawing.clear()
    assert driver.below("/elsewhere/guess") == set()


def job(state="running", scene="s", name="a", **changes):
    params = {"mode": "first", "seed": 0, "of": {"scene": scene}, "names": [BOX], "cameras": ["0", "1"]}
    return Job(name, "estimate", params, state, **{"done": 3, "total": 6, "note": "Looking", **changes})


def step(number=1, estimate=None, x=0.1):
    moved = SceneState((BOX,), Pose(np.array([[0.1 + x, 0, 0.1]]), UPRIGHT[None]), LIGHT, None)
    return EstimateStep(Progress(number, 6, ""), "objects", moved, losses=(1 / number,), estimate=estimate)


class Room:
    """A view whose service is made of air."""

    def __init__(self, server, library):
        self.gui = ViewerDriver(server)
        self.drawing = EstimateNodes(server, library)
        self.panel = EstimatePanel(self.drawing)

    def see(self, of, what):
        self.panel.show(JobView(of, what))
        until(lambda: self.panel.is_idle)

    @property
    def is_empty(self):
        return not self.gui.below("/estimate/guess") and self.gui.node("/estimate/light") is None

    def guess(self):
        node = self.gui.node(f"/estimate/guess/{BOX}")
        return None if node is None else node.batched_positions


@pytest.fixture
def room(server, library):
    room = Room(server, library)
    room.panel.start(record("s"))
    until(lambda: room.panel.is_idle)
    yield room
    room.panel.close()
    room.panel.close()


def test_steps_are_drawn(room):
    room.see(job(), step())
    until(lambda: not room.is_empty)
    room.see(job(), step(2, x=0.2))
    until(lambda: np.allclose(room.guess(), [[0.3, 0, 0.1]]))


def test_what_was_found_goes_once_somebody_moves_something(room):
    room.see(job(), step())
    room.panel.show(SceneChanged(record("s")))
    until(lambda: room.panel.is_idle)
    assert not room.is_empty  # it still runs
    room.panel.show(JobChanged(1, job("done", result={"trusted": True})))
    until(lambda: room.panel.is_idle)
    assert not room.is_empty
    room.panel.show(SceneChanged(record("s")))
    until(lambda: room.is_empty)


def test_only_what_is_about_the_scene_on_view_is_drawn(room):
    room.see(job(scene="other"), step())
    assert room.is_empty
    room.see(job(scene=None, name="upload"), step())
    until(lambda: not room.is_empty)
    room.panel.show(JobChanged(1, job("done", scene=None, name="upload", result={"trusted": False})))
    until(lambda: room.panel.is_idle)
    room.see(job(), step())
    assert not room.is_empty
    room.panel.show(CurrentScene(record()))
    until(lambda: room.is_empty)


def test_one_that_waits_does_not_take_the_view_from_one_that_runs(room):
    room.see(job(), step())
    room.panel.show(JobChanged(1, job("queued", name="b")))
    until(lambda: room.panel.is_idle)
    assert not room.is_empty


def test_a_former_one_that_is_renamed_does_not_take_the_view(room):
    room.see(job(), step())
    room.panel.show(JobChanged(1, job("done", result={"trusted": True})))
    room.panel.show(JobChanged(2, job("done", name="b", result={"trusted": True})))
    until(lambda: room.panel.is_idle)
    assert not room.is_empty


def test_steps_of_jobs_of_other_kinds_are_not_drawn(room):
    other = Job("e", "episode", {"scene": "s", "names": [BOX]}, "running")
    room.panel.show(JobView(other, step()))
    room.panel.show(JobChanged(1, other))
    assert room.panel.is_idle
    assert room.is_empty


def test_of_one_that_failed_nothing_stays(room):
    room.see(job(), step())
    room.panel.show(JobChanged(1, job("failed", error="mask of x is empty.")))
    until(lambda: room.is_empty)


def test_a_defect_in_drawing_does_not_end_the_view(room, monkeypatch):
    with monkeypatch.context() as broken:
        broken.setattr(room.drawing, "show", lambda *_: 1 / 0)
        room.see(job(), step())
    room.see(job(), step(2, EstimatedState(state((BOX,)), np.ones(1), np.ones(1), 0.1, ("",), "")))
    until(lambda: room.gui.below(f"/estimate/verdict/{BOX}"))
