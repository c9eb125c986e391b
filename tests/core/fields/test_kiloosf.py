"""Kiloosf: kiloosf, field weights."""

import struct
from dataclasses import replace

import numpy as np
import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st
from safetensors.numpy import load, save

from osfcore.errors import CannotWrite, CorruptFile
from osfcore.fields.kiloosf import (
    EMPTY_G,
    FEATURES,
    FLOOR_G,
    FORMAT,
    MACRO,
    MAX_FILE_BYTES,
    KiloOSF,
    block_distances,
    field_bytes,
    field_from_bytes,
    network_size,
    read_field,
    read_tensors,
    write_field,
)
from osfcore.fields.kiloosf_query import KiloQuery
from tests.core.render.scenes import HIDDEN, ball, block, random_field

# Kiloosf


def distances_by_hand(density):
    """Every block of 4 x 4 x 4 voxels together with all its 5 x 5 x 5 corners, against every other."""
    shape = [-(-(n - 1) // MACRO) for n in density.shape]
    occupied = []
    for place in np.ndindex(*shape):
        part = density[tuple(slice(MACRO * b, MACRO * (b + 1) + 1) for b in place)]
        if np.any(part > FLOOR_G):
            occupied.append(place)
    blocks = np.full(shape, 255, np.uint8)
    for place in np.ndindex(*shape) if occupied else ():
        blocks[place] = np.abs(np.array(occupied) - place).max(axis=1).min()
    return blocks


@given(shape=st.tuples(*[st.integers(2, 22)] * 3), seed=st.integers(0, 10**6), share=st.sampled_from([0.0, 5e-4, 0.1]))
def test_blocks_know_how_far_away_density_is(shape, seed, share):
    rng = np.random.default_rng(seed)
    density = np.where(rng.random(shape) < share, 1.0, EMPTY_G).astype(np.float32)
    np.testing.assert_array_equal(block_distances(density), distances_by_hand(density))


def test_a_corner_at_the_floor_is_empty():
    density = np.full((6, 6, 6), FLOOR_G, np.float32)
    assert np.all(block_distances(density) == 255)
    density[2, 2, 2] = np.nextafter(np.float32(FLOOR_G), np.float32(0))
    assert (block_distances(density) == 0).sum() == 1


def test_box_and_extent_of_a_block():
    field = block((0.04, 0.03, 0.05), voxel=0.005)
    np.testing.assert_allclose(field.box[0], field.origin, atol=1e-12)
    np.testing.assert_allclose(field.box.sum(axis=0), 0, atol=1e-6)
    # The last solid corner lies on the surface, where g is 0, or within the voxel beyond it.
    assert np.all(field.extent[1] >= np.array([0.04, 0.03, 0.05]) - 1e-6)
    assert np.all(field.extent[1] < np.array([0.04, 0.03, 0.05]) + 0.005)
    np.testing.assert_allclose(field.extent[0], -field.extent[1], atol=1e-6)


def test_the_extent_of_nothing_is_the_whole_box():
    field = block()
    empty = KiloOSF(field.origin, field.voxel, 0 * field.index, field.rows, field.cells, field.networks, field.hidden,
                    field.ambient)  # fmt: skip
    np.testing.assert_array_equal(empty.extent, empty.box)
    assert np.all(empty.macro == 255)


def test_density_and_blocks_are_derived_from_rows():
    field = ball()
    np.testing.assert_array_equal(field.density, field.rows[field.index, 0])
    np.testing.assert_array_equal(field.macro, distances_by_hand(field.density))


@pytest.mark.parametrize("hidden", [1, 8, 16])
def test_a_network_has_as_many_numbers_as_its_layers_use(hidden):
    assert network_size(hidden) == 11 * hidden + hidden + hidden * hidden + hidden + hidden * 3 + 3
    field = ball()
    field = KiloOSF(field.origin, field.voxel, field.index, field.rows, field.cells,
                    np.zeros((1, network_size(hidden)), np.float32), hidden, field.ambient)  # fmt: skip
    x = torch.zeros(1, 3)
    assert KiloQuery(field)(x, x, x).direct.shape == (1, 3)


# Field weights


@pytest.fixture(scope="module")
def field() -> KiloOSF:
    return random_field(np.random.default_rng(0))


def refused(path, data: bytes, match: str) -> None:
    path.write_bytes(data)
    with pytest.raises(CorruptFile, match=match) as caught:
        read_field(path)
    assert str(path) in str(caught.value)


def repacked(field: KiloOSF, hidden=HIDDEN, meta=None, **tensors) -> bytes:
    """The file of a field with some tensors changed; None leaves one out."""
    content = load(field_bytes(field)) | tensors
    content = {name: np.array(t, order="C") for name, t in content.items() if t is not None}
    return save(content, metadata=meta or {"format": FORMAT, "hidden": str(hidden)})


@given(seed=st.integers(0, 10**6))
def test_a_round_trip_loses_no_more_than_half_a_level(tmp_path_factory, seed):
    field = random_field(np.random.default_rng(seed))
    path = tmp_path_factory.mktemp("weights") / "field.safetensors"
    write_field(path, field)
    back = read_field(path)
    for name in ("origin", "index", "ambient"):
        np.testing.assert_array_equal(getattr(back, name), getattr(field, name))
    assert (back.voxel, back.hidden) == (np.float32(field.voxel), field.hidden)
    features = field.rows[1:]
    span = np.ptp(np.concatenate([features, np.zeros((1, FEATURES))]), axis=0)
    assert np.all(np.abs(back.rows[1:] - features) <= span / 255 / 2 + 1e-5)
    np.testing.assert_array_equal(back.rows[0], [EMPTY_G] + [0] * 7)
    networks, ours = field.networks[field.cells], back.networks[back.cells]
    np.testing.assert_allclose(ours, networks, rtol=2**-11, atol=1e-7)
    again = tmp_path_factory.mktemp("weights") / "again.safetensors"
    write_field(again, back)  # what was read is written without further loss, up to one rounding
    np.testing.assert_allclose(read_field(again).rows, back.rows, atol=1e-4)


def test_networks_that_no_cell_uses_are_left_out(tmp_path, field):
    cells = np.where(field.cells > 5, 5, field.cells).astype(np.int32)
    write_field(tmp_path / "a.safetensors", replace(field, cells=cells))
    back = read_field(tmp_path / "a.safetensors")
    assert len(back.networks) == 6
    np.testing.assert_allclose(back.networks[back.cells], field.networks[cells], rtol=2**-11, atol=1e-7)


def test_rows_in_any_order_are_stored_in_that_of_the_grid(tmp_path, field):
    order = np.random.default_rng(1).permutation(len(field.rows) - 1)
    index = field.index.copy()
    index[index > 0] = 1 + order[index[index > 0] - 1]
    rows = field.rows.copy()
    rows[1 + order] = field.rows[1:]
    shuffled = replace(field, index=index, rows=rows)
    np.testing.assert_array_equal(shuffled.density, field.density)
    ours, expected = load(field_bytes(shuffled)), load(field_bytes(field))
    for name, tensor in expected.items():
        np.testing.assert_array_equal(ours[name], tensor)


def test_an_empty_shell_is_refused(tmp_path):
    field = ball()
    nothing = replace(field, index=np.zeros_like(field.index), rows=field.rows[:1])
    refused(tmp_path / "a.safetensors", field_bytes(nothing), "it has no corners, so it shows nothing")


def test_bytes_are_judged_as_a_file_is(field):
    np.testing.assert_array_equal(field_from_bytes(field_bytes(field), "it").index, field.index)
    with pytest.raises(CorruptFile, match="The trained field cannot be used: it is not a whole safetensors file"):
        field_from_bytes(field_bytes(field)[:-1], "The trained field")


@pytest.mark.parametrize(
    ("name", "kind"),
    [
        ("levels", np.float32),
        ("levels", np.int8),
        ("levels", np.uint16),
        ("cells", np.float32),
        ("shape", np.float64),
        ("shell", np.int8),
        ("origin", np.int32),
        ("voxel", np.int32),
        ("networks", np.int16),
        ("ambient", np.uint8),
    ],
)
def test_tensors_of_another_kind_are_refused(tmp_path, field, name, kind):
    other = load(field_bytes(field))[name].astype(kind)
    refused(tmp_path / "a.safetensors", repacked(field, **{name: other}), f"not a sound field .{name} holds")


def test_grids_without_end_are_refused(tmp_path, field):
    refused(tmp_path / "a.safetensors", repacked(field, shape=np.array([np.inf, 5, 5])), "not a sound field .shape")


@pytest.mark.parametrize("name", ["ambient", "span"])
def test_negative_light_is_refused(tmp_path, field, name):
    tensor = load(field_bytes(field))[name].copy()
    tensor[1] = -0.1
    refused(tmp_path / "a.safetensors", repacked(field, **{name: tensor}), "negative")


@pytest.mark.parametrize("meta", ["null", "{}"])
def test_files_without_metadata_are_told(tmp_path, meta):
    header = f'{{"__metadata__":{meta},"a":{{"dtype":"F32","shape":[1],"data_offsets":[0,4]}}}}'.encode()
    data = struct.pack("<Q", len(header)) + header + bytes(4)
    refused(tmp_path / "a.safetensors", data, "no format at all|not a whole safetensors file")


def test_odd_formats_are_told_in_one_short_line(tmp_path, field):
    path = tmp_path / "a.safetensors"
    path.write_bytes(repacked(field, meta={"format": "a\nb" * 5000}))
    with pytest.raises(CorruptFile, match="its format is") as caught:
        read_field(path)
    assert str(caught.value).isprintable()
    assert len(str(caught.value)) < len(str(path)) + 300


def test_a_file_cut_short_anywhere_is_refused(tmp_path, field):
    data = field_bytes(field)
    header = 8 + struct.unpack("<Q", data[:8])[0]
    for length in (0, 1, 7, 8, 9, header // 2, header - 1, header, header + 1, len(data) // 2, len(data) - 1):
        refused(tmp_path / "a.safetensors", data[:length], "not a whole safetensors file")
    refused(tmp_path / "a.safetensors", data + b"x", "not a whole safetensors file")


@given(data=st.binary(max_size=200))
def test_noise_is_refused(tmp_path_factory, data):
    refused(tmp_path_factory.mktemp("noise") / "a.safetensors", data, "whole safetensors file")


@given(place=st.floats(0, 1, exclude_max=True), value=st.integers(0, 255))
def test_a_flipped_byte_gives_a_field_or_a_refusal(tmp_path_factory, field, place, value):
    data = bytearray(field_bytes(field))
    header = 8 + struct.unpack("<Q", bytes(data[:8]))[0]
    data[int(place * (header + 200))] = value  # headers break in more ways than numbers
    path = tmp_path_factory.mktemp("flip") / "a.safetensors"
    path.write_bytes(data)
    try:
        back = read_field(path)
    except CorruptFile:
        return
    assert np.all(np.isfinite(back.rows))


def test_missing_files_and_folders_are_refused(tmp_path):
    for path in (tmp_path / "none.safetensors", tmp_path):
        with pytest.raises(CorruptFile, match="cannot be read"):
            read_field(path)


@pytest.mark.parametrize("meta", [{"format": "kiloosf-2"}, {"format": "table-1"}, {"hidden": "8"}])
def test_other_formats_and_versions_are_told(tmp_path, field, meta):
    found = meta.get("format", "no format at all")
    refused(tmp_path / "a.safetensors", repacked(field, meta=meta), f"its format is {found}.*reads {FORMAT}")
    path = tmp_path / "bare.safetensors"
    path.write_bytes(save({"origin": np.zeros(3)}))
    with pytest.raises(CorruptFile, match="no format at all"):
        read_tensors(path, FORMAT)


@pytest.mark.parametrize(
    "name", ["origin", "voxel", "shape", "shell", "levels", "low", "span", "cells", "networks", "ambient"]
)
def test_a_missing_tensor_is_told(tmp_path, field, name):
    refused(tmp_path / "a.safetensors", repacked(field, **{name: None}), f"not a sound field.*{name}")


@pytest.mark.parametrize("name", ["origin", "voxel", "low", "span", "networks", "ambient"])
@pytest.mark.parametrize("bad", [np.nan, np.inf])
def test_values_that_are_not_finite_are_told(tmp_path, field, name, bad):
    tensor = load(field_bytes(field))[name].copy()
    tensor.reshape(-1)[0] = bad
    refused(tmp_path / "a.safetensors", repacked(field, **{name: tensor}), f"{name} has values that are not finite")


def test_numbers_beyond_all_bounds_are_refused(tmp_path, field):
    for name in ("origin", "low", "span", "ambient"):
        tensor = load(field_bytes(field))[name].copy()
        tensor[0] = 1e30
        refused(tmp_path / "a.safetensors", repacked(field, **{name: tensor}), name)


@pytest.mark.parametrize(
    "name", ["origin", "voxel", "shape", "shell", "levels", "low", "span", "cells", "networks", "ambient"]
)
@pytest.mark.parametrize("shape", ["scalar", "empty", "longer", "deeper"])
def test_tensors_of_another_shape_are_refused(tmp_path, field, name, shape):
    tensor = load(field_bytes(field))[name]
    other = {
        "scalar": tensor.reshape(-1)[0].reshape(()),
        "empty": tensor[:0],
        "longer": np.concatenate([tensor, tensor]),
        "deeper": tensor[..., None],
    }[shape]
    harmless = {("voxel", "longer"), ("voxel", "deeper"), ("networks", "longer"), ("cells", "longer"),
                ("shell", "longer"), ("shell", "deeper")}  # fmt: skip
    if (name, shape) not in harmless:  # the rest of those is ignored, or they still fit
        refused(tmp_path / "a.safetensors", repacked(field, **{name: other}), "not a sound field")


@pytest.mark.parametrize(
    "shape",
    [(0, 5, 5), (1, 5, 5), (-3, 5, 5), (5, 5), (5, 5, 5, 5), (2**20, 2**20, 2**30), (2**32, 2**32, 2), (300, 300, 300)],
)
def test_silly_grids_are_refused_before_memory_is_taken(tmp_path, field, shape):
    refused(tmp_path / "a.safetensors", repacked(field, shape=np.array(shape, np.int64)), "not a sound field")


def test_a_shell_that_touches_the_grids_faces_is_refused(tmp_path, field):
    index = field.index.copy()
    index[0, 3, 3] = len(field.rows)
    touching = replace(field, index=index, rows=np.concatenate([field.rows, field.rows[-1:]]))
    refused(tmp_path / "a.safetensors", field_bytes(touching), "touches the grid's faces")


@pytest.mark.parametrize("bad", [-1, 12, 30_000])
def test_cells_without_a_network_are_refused(tmp_path, field, bad):
    cells = load(field_bytes(field))["cells"].copy()
    cells[0, 0, 0] = bad
    refused(tmp_path / "a.safetensors", repacked(field, cells=cells), "not a sound field.*cells")


@pytest.mark.parametrize("hidden", [-1, 0, 7, 65, 300, "many"])
def test_networks_of_another_width_are_refused(tmp_path, field, hidden):
    """Also consistent ones beyond what the renderer has room for."""
    width = network_size(hidden) if isinstance(hidden, int) and hidden > 7 else network_size(HIDDEN)
    networks = np.zeros((12, width), np.float16)
    refused(tmp_path / "a.safetensors", repacked(field, hidden=hidden, networks=networks), "not a sound field")


@pytest.mark.parametrize("voxel", [0.0, -0.1, 1e-12, 1e12])
def test_silly_voxels_are_refused(tmp_path, field, voxel):
    refused(tmp_path / "a.safetensors", repacked(field, voxel=np.float32([voxel])), "voxel")


def test_huge_files_are_not_even_read(tmp_path):
    path = tmp_path / "a.safetensors"
    with path.open("wb") as file:
        file.truncate(MAX_FILE_BYTES + 1)  # sparse
    with pytest.raises(CorruptFile, match="larger than 64 MB"):
        read_field(path)


def test_a_disk_that_refuses_leaves_the_old_file(tmp_path, field, monkeypatch):
    path = tmp_path / "deep" / "field.safetensors"
    write_field(path, field)
    before = path.read_bytes()

    def full(self, data):
        with self.open("wb") as file:
            file.write(data[: len(data) // 2])
        raise OSError(28, "No space left on device")

    monkeypatch.setattr("pathlib.Path.write_bytes", full)
    with pytest.raises(CannotWrite, match="No space left on device"):
        write_field(path, ball())
    assert path.read_bytes() == before
    assert list(path.parent.iterdir()) == [path]
