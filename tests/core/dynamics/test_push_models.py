import numpy as np
import pytest

from osfcore.dynamics.graph import shipped, write_network
from osfcore.dynamics.rollout import NETWORK_FILE, load_push_model, load_shapes, network_path
from osfcore.dynamics.shapes import object_shape
from osfcore.errors import CorruptFile, UnknownName
from osfcore.fields.field_library import FIELD_FILE, FieldLibrary
from osfcore.fields.kiloosf import write_field
from tests.core.dynamics.scenes import APPLE, CAN, network, scene
from tests.core.dynamics.solids import bracket
from tests.core.render.scenes import ball

FIELDS = FieldLibrary(None)
BANANA = "011_banana"
HOLLOW = {BANANA, "019_pitcher_base", "022_windex_bottle", "024_bowl", "025_mug", "035_power_drill"}


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


@pytest.fixture
def trained(tmp_path):
    """A field trained on this machine, of a bracket."""
    path = tmp_path / "fields" / "bracket" / FIELD_FILE
    write_field(path, bracket())
    return FieldLibrary(tmp_path)


@pytest.mark.slow
def test_shipped_parts_are_those_of_the_shipped_fields(monkeypatch):
    monkeypatch.setattr("osfcore.dynamics.rollout.field_parts", lambda _: pytest.fail("parts do not fit their field"))
    counts = {name: len(shape.parts) for name, shape in load_shapes(None, FIELDS, FIELDS.names()).items()}
    assert {name for name, count in counts.items() if count} == HOLLOW


@pytest.mark.slow
def test_shipped_parts_can_be_made_again():
    kept = load_shapes(None, FIELDS, [BANANA])[BANANA].parts
    parts = field_parts(FIELDS.load(BANANA))
    made = object_shape(FIELDS.load(BANANA), parts).parts
    for a, b in zip(kept, made, strict=True):
        np.testing.assert_allclose(a, b, atol=1e-5)


def test_parts_of_an_own_field_are_made_once(tmp_path, trained, monkeypatch):
    first = load_shapes(tmp_path, trained, ["bracket"])["bracket"]
    assert len(first.parts) >= 2
    monkeypatch.setattr("osfcore.dynamics.rollout.field_parts", lambda _: pytest.fail("made again"))
    again = load_shapes(tmp_path, trained, ["bracket"])["bracket"]
    assert all(np.array_equal(a, b) for a, b in zip(first.parts, again.parts, strict=True))


def test_a_field_that_was_trained_again_gets_new_parts(tmp_path, trained):
    load_shapes(tmp_path, trained, ["bracket"])
    write_field(trained.folder("bracket") / FIELD_FILE, ball(0.05, voxel=0.004))
    assert load_shapes(tmp_path, trained, ["bracket"])["bracket"].parts == ()


def test_where_nothing_can_be_kept_shapes_are_known_all_the_same(tmp_path, trained):
    (tmp_path / "dynamics").write_bytes(b"no folder")
    assert len(load_shapes(tmp_path, trained, ["bracket"])["bracket"].parts) >= 2
    assert len(load_shapes(None, trained, ["bracket"])["bracket"].parts) >= 2


def test_an_object_without_a_field_is_told():
    with pytest.raises(UnknownName, match="teapot"):
        load_push_model(None, FIELDS, ["teapot"])


def test_a_broken_network_is_told_rather_than_passed_over(tmp_path):
    (tmp_path / "dynamics").mkdir()
    (tmp_path / "dynamics" / NETWORK_FILE).write_bytes(b"broken")
    with pytest.raises(CorruptFile, match=NETWORK_FILE):
        load_push_model(tmp_path, FIELDS, [CAN])
