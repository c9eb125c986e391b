import pickle

import numpy as np

from app.processes.messages.scene_messages import Act, EditScene, SceneChanged, TakeImage
from osfcore.geometry.poses import Pose
from tests.app.storage.test_database import record


def test_everything_crosses_a_pipe():
    sent = record()
    change = pickle.loads(pickle.dumps(SceneChanged(sent, (sent.state,), 0.1)))
    assert change.record.id == sent.id
    assert np.array_equal(change.states[0].poses.position, sent.state.poses.position)
    edit = pickle.loads(pickle.dumps(EditScene("a", None, (("x", Pose.identity()),))))
    assert edit.poses[0][0] == "x"
    assert pickle.loads(pickle.dumps(Act("a", (np.ones(3),)))).actions[0].tolist() == [1, 1, 1]


def test_pictures_asked_for_twice_are_the_same_key():
    assert TakeImage("a", "0", 64) == TakeImage("a", "0", 64)
    assert hash(TakeImage("a", "0", 64)) != hash(TakeImage("a", "0", 64, masks=True))
