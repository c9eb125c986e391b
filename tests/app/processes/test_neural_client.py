import os
import signal
from concurrent.futures import Future

import numpy as np
import pytest

from app.processes.client import MAX_PENDING, ProcessBusy, ProcessClient, ProcessUnavailable
from app.processes.messages.neural_messages import DrawnView, DrawView, Predicted, PredictPushes
from app.processes.predict_process import predictor_main
from app.processes.render_process import renderer_main
from app.processes.server import InternalError
from osfcore.errors import UnknownName
from osfcore.geometry.cameras import goal_camera
from osfcore.geometry.states import SceneState
from tests.app.conftest import until
from tests.support.errors import about

COMPILE_S = 180  # the first time on a machine


def renderer(fields_dir):
    return ProcessClient(renderer_main, (fields_dir,), "neural renderer")


@pytest.fixture(scope="module")
def link(fields_dir):
    link = renderer(fields_dir)
    yield link
    link.stop()
    link.stop()


def draw(link, state, *, key="a", size=64, is_sharp=False) -> Future:
    return link.submit(DrawView(key, state, goal_camera(size), is_sharp))


def test_it_starts_with_the_first_order(fields_dir, state):
    link = renderer(fields_dir)
    assert link.process is None
    assert not link.is_warm
    drawn = draw(link, state).result(COMPILE_S)
    assert isinstance(drawn, DrawnView)
    assert drawn.image.shape == (64, 64, 3)
    assert link.is_warm
    link.stop()
    assert not link.process.is_alive()
    with pytest.raises(ProcessUnavailable):
        draw(link, state).result(5)


@pytest.mark.slow
def test_of_many_orders_of_one_visitor_the_last_is_drawn(link, state):
    draw(link, state).result(COMPILE_S)
    futures = [draw(link, state, size=512, is_sharp=True) for _ in range(6)]
    answers = [future.result(60) for future in futures]
    assert isinstance(answers[-1], DrawnView)
    assert sum(answer is None for answer in answers) >= 4


def test_refusals_are_told_in_words(link, state):
    other = SceneState(("teapot",), state.poses, state.light, None)
    with pytest.raises(UnknownName, check=about("teapot")):
        draw(link, other).result(COMPILE_S)


def test_too_much_at_once_is_refused(link, state):
    futures = [draw(link, state, key=f"k{n}", size=256, is_sharp=True) for n in range(2 * MAX_PENDING)]
    kinds = {type(future.exception(COMPILE_S)) for future in futures}
    assert kinds == {type(None), ProcessBusy}


@pytest.mark.slow
def test_a_killed_renderer_says_so_and_comes_back(link, state):
    draw(link, state).result(COMPILE_S)
    process = link.process
    os.kill(process.pid, signal.SIGSTOP)
    waiting = draw(link, state)
    os.kill(process.pid, signal.SIGKILL)
    with pytest.raises(ProcessUnavailable):
        waiting.result(20)
    until(lambda: not process.is_alive())
    assert isinstance(draw(link, state).result(COMPILE_S), DrawnView)
    assert link.process is not process


def test_one_that_keeps_dying_is_left_alone_for_a_while(fields_dir, state):
    link = renderer(fields_dir)
    for _ in range(2):
        waiting = draw(link, state)
        link.process.kill()
        assert isinstance(waiting.exception(20), ProcessUnavailable)
    with pytest.raises(ProcessUnavailable):
        draw(link, state).result(5)
    link.stop()


@pytest.mark.slow
def test_it_runs_other_processes_under_their_own_name(fields_dir, state):
    link = ProcessClient(predictor_main, (fields_dir,), "predictor of pushes")
    predicted = link.submit(PredictPushes("a", state, np.zeros((1, 2, 3)))).result(COMPILE_S)
    assert isinstance(predicted, Predicted)
    with pytest.raises(InternalError):
        draw(link, state).result(20)
    link.stop()
    with pytest.raises(ProcessUnavailable):
        draw(link, state).result(5)
