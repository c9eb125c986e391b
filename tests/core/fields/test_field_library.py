import json

import numpy as np
import pytest

from osfcore.errors import CorruptFile, UnknownName
from osfcore.fields.field_library import FieldLibrary
from osfcore.fields.kiloosf import write_field
from osfcore.fields.table import write_table
from tests.core.render.scenes import ball, block, plain_table, wooden_table


@pytest.fixture
def shipped(tmp_path):
    """A package with two fields and a table; one field has metrics."""
    folder = tmp_path / "package"
    write_field(folder / "ball.safetensors", ball())
    (folder / "ball.json").write_text('{"psnr_full": 35.5}')
    write_field(folder / "block.safetensors", block())
    write_table(folder / "table.safetensors", plain_table())
    return folder


@pytest.fixture
def data_dir(tmp_path):
    return tmp_path / "data"


def place(data_dir, name, field, metrics=None):
    write_field(data_dir / "fields" / name / "field.safetensors", field)
    if metrics is not None:
        (data_dir / "fields" / name / "field.json").write_text(metrics)


def test_shipped_fields_are_there_without_a_data_directory(shipped, data_dir):
    for where in (None, data_dir):
        library = FieldLibrary(where, shipped=shipped)
        assert library.names() == ("ball", "block")
        info = library.info("ball")
        assert (info.name, info.source, info.metrics) == ("ball", "shipped", {"psnr_full": 35.5})
        assert info.bytes == info.path.stat().st_size > 1000
        assert library.info("block").metrics == {}
        np.testing.assert_allclose(library.load("ball").extent, ball().extent, atol=1e-6)
        assert library.has("block")
        assert not library.has("mug")


def test_trained_fields_join_them_and_win(shipped, data_dir):
    library = FieldLibrary(data_dir, shipped=shipped)
    place(data_dir, "mug", ball(0.03))
    place(data_dir, "ball", ball(0.02), '{"psnr_full": 40}')
    assert library.names() == ("ball", "block", "mug")
    info = library.info("ball")
    assert (info.source, info.metrics) == ("trained", {"psnr_full": 40})
    assert info.path == library.folder("ball") / "field.safetensors"
    assert library.load("ball").extent[1, 0] < 0.03
    assert library.info("block").source == "shipped"
    (library.folder("ball") / "field.safetensors").unlink()
    assert library.info("ball").source == "shipped"


def test_a_broken_trained_field_is_told_and_not_passed_over(shipped, data_dir):
    place(data_dir, "ball", ball())
    path = data_dir / "fields" / "ball" / "field.safetensors"
    path.write_bytes(path.read_bytes()[:-10])
    with pytest.raises(CorruptFile, match=r"ball/field\.safetensors cannot be used"):
        FieldLibrary(data_dir, shipped=shipped).load("ball")


@pytest.mark.parametrize("text", ["", "{", "[1]", '"words"', "\x00", '{"a": ' * 5000])
def test_metrics_that_cannot_be_read_are_not_known(shipped, data_dir, text):
    place(data_dir, "mug", ball(), text)
    assert FieldLibrary(data_dir, shipped=shipped).info("mug").metrics == {}
    (data_dir / "fields" / "mug" / "field.json").write_bytes(b"\xff\xfe{}")
    assert FieldLibrary(data_dir, shipped=shipped).info("mug").metrics == {}


def test_of_metrics_only_what_is_known_and_plain_is_told(shipped, data_dir):
    good = {"psnr_full": 35.5, "minutes": 2, "device": "cpu", "hollow": True}
    bad = {"psnr_mask": float("nan"), "bytes": 10**400, "seed": True, "threads": "1", "data": "a\ud800",
           "machine": "x" * 5000, "command": ["osf"], "further": 1, "psnr": [[1]]}  # fmt: skip
    place(data_dir, "mug", ball(), json.dumps(good | bad))
    assert FieldLibrary(data_dir, shipped=shipped).info("mug").metrics == good
    place(data_dir, "mug", ball(), f'{{"psnr_full": 35.5, "recipe": {"[" * 900}{"]" * 900}}}')
    assert FieldLibrary(data_dir, shipped=shipped).info("mug").metrics == {"psnr_full": 35.5}


def test_folders_with_unprintable_names_hold_no_fields(shipped, data_dir):
    place(data_dir, "a\nb", ball())
    place(data_dir, "\udc80", ball())
    assert FieldLibrary(data_dir, shipped=shipped).names() == ("ball", "block")


def test_unknown_names_are_told_with_the_known_ones(shipped, data_dir):
    place(data_dir, "mug", ball())
    library = FieldLibrary(data_dir, shipped=shipped)
    for ask in (library.info, library.load):
        for name in ("cup", "", "../package/ball", "table"):
            with pytest.raises(UnknownName, match="known: ball, block, mug"):
                ask(name)


def test_a_field_that_is_deleted_while_it_is_asked_for_is_unknown(shipped, data_dir, monkeypatch):
    monkeypatch.setattr(FieldLibrary, "has", lambda *_: True)  # as it was a moment ago
    with pytest.raises(UnknownName, match="no field named .mug."):
        FieldLibrary(data_dir, shipped=shipped).info("mug")


def test_without_a_data_directory_nothing_can_be_placed(shipped):
    with pytest.raises(UnknownName, match="folder"):
        FieldLibrary(None, shipped=shipped).folder("mug")


def test_a_folder_without_a_field_is_none(shipped, data_dir):
    (data_dir / "fields" / "half").mkdir(parents=True)
    (data_dir / "fields" / "stray.txt").write_text("")
    (data_dir / "fields" / "half" / "field.json").write_text("{}")
    assert FieldLibrary(data_dir, shipped=shipped).names() == ("ball", "block")


def test_the_table_may_be_replaced_too(shipped, data_dir):
    library = FieldLibrary(data_dir, shipped=shipped)
    np.testing.assert_array_equal(library.load_table().albedo, plain_table().albedo)
    write_table(data_dir / "fields" / "table" / "field.safetensors", wooden_table())
    np.testing.assert_array_equal(library.load_table().albedo, wooden_table().albedo)
    assert library.names() == ("ball", "block")


def test_a_package_without_its_table_is_told(tmp_path):
    with pytest.raises(CorruptFile, match="the package lacks its table"):
        FieldLibrary(None, shipped=tmp_path).load_table()


def test_everything_that_ships_can_be_used():
    """Each file is sound, small enough, and says what it measured."""
    library = FieldLibrary(None)
    total = 0
    for name in library.names():
        info = library.info(name)
        total += info.bytes
        assert info.bytes <= 2_000_000
        assert {"psnr_full", "psnr_mask", "minutes", "bytes"} <= set(info.metrics)
        assert info.metrics["bytes"] == info.bytes
        field = library.load(name)
        assert np.all(np.ptp(field.extent, axis=0) < 0.5)  # metres
        json.dumps(dict(info.metrics))
    assert total <= 45_000_000
    if library.names():
        assert library.load_table().half_side == pytest.approx(0.6)
