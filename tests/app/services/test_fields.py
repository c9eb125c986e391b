import json
from pathlib import Path

import pytest

from app.services.fields import FieldCatalogue, MissingFields, NoPublishedField, ShippedField
from osfcore.errors import UnknownName
from osfcore.fields.field_library import FIELD_FILE, METRICS_FILE, FieldInfo, FieldLibrary
from osfcore.paper.method import own_field_path


@pytest.fixture
def shelf(tmp_path):
    return FieldCatalogue(tmp_path, lambda: ("mug",))


def put(data_dir, name):
    folder = data_dir / "fields" / name
    folder.mkdir(parents=True)
    (folder / FIELD_FILE).write_bytes(b"weights")
    (folder / METRICS_FILE).write_text(json.dumps({"psnr_full": 30.0, "psnr_mask": 25.0}))
    return folder


def test_what_was_trained_here_is_told_and_can_be_deleted(shelf, tmp_path):
    folder = put(tmp_path, "mug")
    put(tmp_path, "own_thing")
    trained = {info.name: info for info in shelf.all() if info.source == "trained"}
    assert set(trained) == {"mug", "own_thing"}
    assert (trained["mug"].bytes, trained["mug"].metrics["psnr_mask"]) == (7, 25.0)
    assert shelf.has_mesh("mug")
    assert not shelf.has_mesh("own_thing")
    shelf.remove("mug")
    assert not folder.exists()
    with pytest.raises(UnknownName):
        shelf.remove("mug")


def test_what_is_shipped_stays(shelf, monkeypatch):
    shipped = FieldInfo("mug", "shipped", Path("mug.safetensors"), 7, {})
    monkeypatch.setattr(FieldLibrary, "info", lambda _library, _name: shipped)
    with pytest.raises(ShippedField):
        shelf.remove("mug")


def test_a_method_is_refused_objects_without_its_fields(shelf, tmp_path):
    put(tmp_path, "mug")
    shelf.require(("mug",), "ours")
    with pytest.raises(NoPublishedField):
        shelf.require(("mug", "006_mustard_bottle"), "paper")
    with pytest.raises(MissingFields):
        shelf.require(("mug", "teapot"), "paper")
    own = own_field_path("mug", tmp_path)
    own.parent.mkdir()
    own.write_bytes(b"weights")
    shelf.require(("mug", "006_mustard_bottle"), "paper")


def test_a_field_as_published_that_was_trained_here_can_be_deleted_and_a_shipped_one_counts_again(shelf, tmp_path):
    bottle = "006_mustard_bottle"
    assert (shelf.origin_of_published(bottle), shelf.origin_of_published("mug")) == ("shipped", None)
    with pytest.raises(ShippedField):
        shelf.remove_published(bottle)
    own = own_field_path(bottle, tmp_path)
    own.parent.mkdir()
    for file in (own, own.with_suffix(".json")):
        file.write_bytes(b"{}")
    assert shelf.origin_of_published(bottle) == "trained"
    shelf.remove_published(bottle)
    assert shelf.origin_of_published(bottle) == "shipped"
    assert list(own.parent.iterdir()) == []
