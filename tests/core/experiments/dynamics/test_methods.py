import numpy as np
import pytest

from osfcore.errors import InvalidInput
from osfcore.experiments.dynamics import METHODS, as_published, check_method, load_predictor
from osfcore.experiments.dynamics_scores import learned, windows_of
from osfcore.fields.field_library import FieldLibrary
from osfcore.geometry.light import Light
from osfcore.geometry.poses import Pose
from osfcore.geometry.states import SceneState
from osfcore.paper.dynamics import WEIGHTS_FILE, PaperPushModel, write_network
from tests.core.dynamics.scenes import network as our_network
from tests.core.experiments.pushes import NAMES, episode, shapes
from tests.core.paper.scenes import KAPPAS, network

FIELDS = FieldLibrary(None)


@pytest.fixture(scope="module")
def windows():
    return windows_of([episode(speed=0.005, turn=0.02), episode(speed=-0.002, names=NAMES[::-1])])


def test_windows_are_predicted_as_rollouts_from_their_starts(windows):
    found = as_published(network(), KAPPAS, windows)
    model = PaperPushModel(network(), KAPPAS)
    assert found.positions.shape == windows.positions[:, 2:].shape
    for w, names in enumerate(windows.names):
        pose = Pose(windows.positions[w, 1], windows.quaternions[w, 1])
        state = SceneState(names, pose, Light(np.array([0.0, 0, 1])), windows.pusher[w, 1])
        alone = model.rollout(state, windows.actions[w : w + 1])
        np.testing.assert_allclose(found.positions[w, :4], alone.positions[0, 1:5], atol=1e-4)
        np.testing.assert_allclose(found.quaternions[w, :4], alone.quaternions[0, 1:5], atol=1e-3)


def test_each_method_has_its_own_network(windows, tmp_path):
    write_network(tmp_path / "dynamics" / WEIGHTS_FILE, network())
    paper = load_predictor("paper", tmp_path, FIELDS, shapes())
    published = paper.predict(windows)
    ours = load_predictor("ours", tmp_path, FIELDS, shapes()).predict(windows)
    assert (published.positions != ours.positions).any()
    assert set(paper.model.names) == set(NAMES)
    assert not np.array_equal(ours.positions, learned(our_network(), shapes(), windows).positions)


def test_other_methods_are_told():
    assert METHODS == ("ours", "paper")
    for method in METHODS:
        check_method(method)
    with pytest.raises(InvalidInput, match="method is 'theirs'"):
        check_method("theirs")
