import json

import numpy as np
import pytest

from osfcore.errors import CorruptFile, UnknownName
from osfcore.fields.field_library import FieldLibrary
from osfcore.fields.kiloosf import write_field
from osfcore.fields.table import write_table
from tests.support.errors import about
from tests.support.rendered_scenes import ball, block, plain_table, wooden_table


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


@pytest.fixture
def library(shipped, data_dir):
    return FieldLibrary(data_dir, shipped=shipped)


def place(data_dir, name, field, metrics=None):
    write_field(data_dir / "fields" / name / "field.safetensors", field)
    if metrics is not None:
        (data_dir / "fields" / name / "field.json").write_text(metrics)


def test_shipped_fields_are_there_without_a_data_directory(shipped, library):
    for one in (FieldLibrary(None, shipped=shipped), library):
        assert one.names() == ("ball", "block")
        info = one.info("ball")
        assert (info.name, info.source, info.metrics) == ("ball", "shipped", {"psnr_full": 35.5})
        assert info.bytes == info.path.stat().st_size
        assert one.info("block").metrics == {}
        np.testing.assert_allclose(one.load("ball").extent, ball().extent, atol=1e-6)
        assert one.has("block")
        assert not one.has("mug")
    with pytest.raises(UnknownName):
        FieldLibrary(None, shipped=shipped).folder("mug")


def test_trained_fields_join_them_and_win(library, data_dir):
    place(data_dir, "mug", ball(0.03))
    place(data_dir, "ball", ball(0.02), '{"psnr_full": 40}')
    assert library.names() == ("ball", "block", "mug")
    info = library.info("ball")
    assert (info.source, info.metrics) == ("trained", {"psnr_full": 40})
    assert info.path == library.folder("ball") / "field.safetensors"
    assert library.load("ball").extent[1, 0] < 0.03
    info.path.write_bytes(info.path.read_bytes()[:-10])
    with pytest.raises(CorruptFile) as caught:  # and is not passed over
        library.load("ball")
    assert caught.value.path == str(info.path)
    info.path.unlink()
    assert library.info("ball").source == "shipped"


def test_only_known_and_plain_metrics_are_shown(library, data_dir):
    good = {"psnr_full": 35.5, "minutes": 2, "device": "cpu", "hollow": True}
    bad = {"psnr_mask": float("nan"), "bytes": 10**400, "seed": True, "threads": "1", "data": "a\ud800",
           "machine": "x" * 5000, "command": ["osf"], "further": 1, "psnr": [[1]]}  # fmt: skip
    place(data_dir, "mug", ball(), json.dumps(good | bad))
    assert library.info("mug").metrics == good
    place(data_dir, "mug", ball(), f'{{"psnr_full": 35.5, "recipe": {"[" * 900}{"]" * 900}}}')
    assert library.info("mug").metrics == {"psnr_full": 35.5}
    for unreadable in (b"", b"{", b"[1]", b"\x00", b'{"a": ' * 5000, b"\xff\xfe{}"):
        (data_dir / "fields" / "mug" / "field.json").write_bytes(unreadable)
        assert library.info("mug").metrics == {}


def test_unknown_names_are_refused(library, data_dir):
    place(data_dir, "mug", ball())
    for name in ("cup", "", "../package/ball", "table"):
        with pytest.raises(UnknownName) as caught:
            library.load(name)
        assert (caught.value.kind, caught.value.name) == ("field", name)


def test_a_field_that_is_deleted_while_it_is_asked_for_is_unknown(shipped, data_dir):
    class Late(FieldLibrary):
        def has(self, name):
            return True  # as it was a moment ago

    with pytest.raises(UnknownName, check=about("mug")):
        Late(data_dir, shipped=shipped).info("mug")


def test_folders_without_a_field_or_with_unprintable_names_are_none(library, data_dir):
    for name in ("a\nb", "\udc80"):
        place(data_dir, name, ball())
    (data_dir / "fields" / "half").mkdir()
    (data_dir / "fields" / "half" / "field.json").write_text("{}")
    (data_dir / "fields" / "stray.txt").write_text("")
    assert library.names() == ("ball", "block")


def test_the_table_may_be_replaced_too(library, data_dir, tmp_path):
    np.testing.assert_array_equal(library.load_table().albedo, plain_table().albedo)
    write_table(data_dir / "fields" / "table" / "field.safetensors", wooden_table())
    np.testing.assert_array_equal(library.load_table().albedo, wooden_table().albedo)
    assert library.names() == ("ball", "block")
    with pytest.raises(CorruptFile):
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
        assert np.all(np.ptp(library.load(name).extent, axis=0) < 0.5)  # metres
    assert total <= 45_000_000
    assert library.load_table().half_side == pytest.approx(0.6)
