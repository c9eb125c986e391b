import numpy as np
import pytest

from osfcore.dynamics.library import NETWORK_FILE, load_push_model, network_path
from osfcore.dynamics.weights import shipped, write_network
from osfcore.errors import CorruptFile, UnknownName
from osfcore.fields.library import FieldLibrary
from tests.core.dynamics.scenes import APPLE, CAN, network, scene

FIELDS = FieldLibrary(None)


def test_a_network_of_this_machine_comes_first(tmp_path):
    assert network_path(None) == network_path(tmp_path) == shipped()
    own = tmp_path / "dynamics" / NETWORK_FILE
    write_network(own, network())
    assert network_path(tmp_path) == own


def test_the_model_knows_the_objects_asked_for_and_predicts(tmp_path, shapes):
    write_network(tmp_path / "dynamics" / NETWORK_FILE, network(silent=True))
    model = load_push_model(tmp_path, FIELDS, [CAN, APPLE])
    assert model.names == (CAN, APPLE)
    found = model.rollout(scene(shapes, {CAN: (0.06, 0.0)}), np.array([[[0.3, 0.0, 0.0]]]))
    assert found.positions[0, 1, 0, 0] > 0.07


def test_an_object_without_a_field_is_told():
    with pytest.raises(UnknownName, match="teapot"):
        load_push_model(None, FIELDS, ["teapot"])


def test_a_broken_network_is_told_rather_than_passed_over(tmp_path):
    (tmp_path / "dynamics").mkdir()
    (tmp_path / "dynamics" / NETWORK_FILE).write_bytes(b"broken")
    with pytest.raises(CorruptFile, match=NETWORK_FILE):
        load_push_model(tmp_path, FIELDS, [CAN])
