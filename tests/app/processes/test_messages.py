import pickle

import numpy as np

from app.processes import messages
from app.processes.messages import Act, EditScene, Failure, Request, SceneChanged, TakeImage
from osfcore.errors import OverlappingObjects
from osfcore.geometry.poses import Pose
from tests.app.storage.test_database import record


def test_everything_crosses_a_pipe():
    sent = record()
    change = pickle.loads(pickle.dumps(SceneChanged(sent, (sent.state,), 0.1)))
    assert change.record.id == sent.id
    assert np.array_equal(change.states[0].poses.position, sent.state.poses.position)
    request = pickle.loads(pickle.dumps(Request(3, EditScene("a", None, (("x", Pose.identity()),)))))
    assert request.command.poses[0][0] == "x"
    assert pickle.loads(pickle.dumps(Act("a", (np.ones(3),)))).actions[0].tolist() == [1, 1, 1]


def test_an_error_keeps_its_kind_and_words():
    failure = pickle.loads(pickle.dumps(Failure.of(OverlappingObjects("a", "b", 0.01), 7)))
    assert failure == Failure(7, "OverlappingObjects", "a and b overlap by 10 mm; move one of them away.")


def test_pictures_asked_for_twice_are_the_same_key():
    assert TakeImage("a", "0", 64) == TakeImage("a", "0", 64)
    assert hash(TakeImage("a", "0", 64)) != hash(TakeImage("a", "0", 64, masks=True))


def test_messages_are_frozen():
    kinds = [kind for kind in vars(messages).values() if hasattr(kind, "__dataclass_params__")]
    assert kinds
    assert all(kind.__dataclass_params__.frozen for kind in kinds)
