import pickle

import numpy as np

from app.processes.messages.neural_messages import CompareView, Comparison, DrawnView, DrawView
from osfcore.geometry.cameras import goal_camera
from osfcore.geometry.light import Light
from osfcore.geometry.poses import Pose
from osfcore.geometry.states import SceneState

STATE = SceneState(("a",), Pose(np.zeros((1, 3)), np.array([[1.0, 0, 0, 0]])), Light(np.array([0, 0, 1.0])), None)


def test_all_survive_the_way_to_the_other_process():
    for message in (
        DrawView("view-1", STATE, goal_camera(32), is_sharp=True),
        CompareView("x", STATE, goal_camera(32), b"png"),
        DrawnView(np.zeros((2, 2, 3), np.uint8), np.ones((2, 2), np.float32)),
        Comparison(b"a", b"b", b"c", 30.0),
    ):
        back = pickle.loads(pickle.dumps(message))
        assert type(back) is type(message)
    assert back == Comparison(b"a", b"b", b"c", 30.0)
