import struct
from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from safetensors.numpy import load, save

from osfcore.errors import CorruptFile
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
    tensor_format,
    write_field,
)
from tests.support.rendered_scenes import HIDDEN, block, random_field


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
    density = np.where(rng.random(shape) < share, np.nextafter(np.float32(FLOOR_G), np.float32(0)), FLOOR_G)
    np.testing.assert_array_equal(block_distances(density), distances_by_hand(density))


def test_box_and_extent_of_a_block():
    field = block((0.04, 0.03, 0.05), voxel=0.005)
    np.testing.assert_allclose(field.box[0], field.origin, atol=1e-12)
    np.testing.assert_allclose(field.box.sum(axis=0), 0, atol=1e-6)
    # The last solid corner lies on the surface, where g is 0, or within the voxel beyond it.
    assert np.all(field.extent[1] >= np.array([0.04, 0.03, 0.05]) - 1e-6)
    assert np.all(field.extent[1] < np.array([0.04, 0.03, 0.05]) + 0.005)
    np.testing.assert_allclose(field.extent[0], -field.extent[1], atol=1e-6)
    np.testing.assert_array_equal(field.density, field.rows[field.index, 0])
    np.testing.assert_array_equal(field.macro, distances_by_hand(field.density))
    empty = replace(field, index=0 * field.index)
    np.testing.assert_array_equal(empty.extent, empty.box)
    assert np.all(empty.macro == 255)


# Files


@pytest.fixture(scope="module")
def field() -> KiloOSF:
    return random_field(np.random.default_rng(0))


def repacked(field: KiloOSF, hidden=HIDDEN, meta=None, **tensors) -> bytes:
    """The file of a field with some tensors changed; None leaves one out."""
    content = load(field_bytes(field)) | tensors
    content = {name: np.array(t, order="C") for name, t in content.items() if t is not None}
    return save(content, metadata=meta or {"format": FORMAT, "hidden": str(hidden)})


def refuse(*files: bytes) -> None:
    for data in files:
        with pytest.raises(CorruptFile):
            field_from_bytes(data, "it")


@settings(max_examples=30)
@given(seed=st.integers(0, 10**6))
def test_a_round_trip_loses_no_more_than_half_a_level(seed):
    field = random_field(np.random.default_rng(seed))
    back = field_from_bytes(field_bytes(field), "it")
    for name in ("origin", "index", "ambient"):
        np.testing.assert_array_equal(getattr(back, name), getattr(field, name))
    assert (back.voxel, back.hidden) == (np.float32(field.voxel), field.hidden)
    features = field.rows[1:]
    span = np.ptp(np.concatenate([features, np.zeros((1, FEATURES))]), axis=0)
    assert np.all(np.abs(back.rows[1:] - features) <= span / 255 / 2 + 1e-5)
    np.testing.assert_array_equal(back.rows[0], [EMPTY_G] + [0] * 7)
    networks, ours = field.networks[field.cells], back.networks[back.cells]
    np.testing.assert_allclose(ours, networks, rtol=2**-11, atol=1e-7)
    again = field_from_bytes(field_bytes(back), "it")  # without further loss, up to one rounding
    np.testing.assert_allclose(again.rows, back.rows, atol=1e-4)


def test_networks_that_no_cell_uses_are_left_out(field):
    cells = np.where(field.cells > 5, 5, field.cells).astype(np.int32)
    back = field_from_bytes(field_bytes(replace(field, cells=cells)), "it")
    assert len(back.networks) == 6
    np.testing.assert_allclose(back.networks[back.cells], field.networks[cells], rtol=2**-11, atol=1e-7)


def test_rows_in_any_order_are_stored_in_that_of_the_grid(field):
    order = np.random.default_rng(1).permutation(len(field.rows) - 1)
    index = field.index.copy()
    index[index > 0] = 1 + order[index[index > 0] - 1]
    rows = field.rows.copy()
    rows[1 + order] = field.rows[1:]
    stored, ours = load(field_bytes(field)), load(field_bytes(replace(field, index=index, rows=rows)))
    assert stored.keys() == ours.keys()
    for name, tensor in stored.items():
        np.testing.assert_array_equal(ours[name], tensor)


def test_files_that_are_missing_or_huge_are_refused(field, tmp_path):
    path, huge = tmp_path / "deep" / "field.safetensors", tmp_path / "huge.safetensors"
    write_field(path, field)
    np.testing.assert_array_equal(read_field(path).index, field.index)
    assert tensor_format(path) == FORMAT
    with huge.open("wb") as file:
        file.truncate(MAX_FILE_BYTES + 1)  # sparse
    for other in (huge, tmp_path / "none.safetensors", tmp_path):
        with pytest.raises(CorruptFile) as caught:
            read_field(other)
        assert caught.value.path == str(other)


def test_files_cut_short_of_other_formats_or_without_metadata_are_refused(field, tmp_path):
    data = field_bytes(field)
    header = 8 + struct.unpack("<Q", data[:8])[0]
    refuse(*(data[:length] for length in (0, 7, 8, 9, header - 1, header, header + 1, len(data) - 1)), data + b"x")
    for meta in ("null", "{}"):
        head = f'{{"__metadata__":{meta},"a":{{"dtype":"F32","shape":[1],"data_offsets":[0,4]}}}}'.encode()
        refuse(struct.pack("<Q", len(head)) + head + bytes(4))
    refuse(*(repacked(field, meta=meta) for meta in ({"format": "kiloosf-2"}, {"format": "table-1"}, {"hidden": "8"})))
    path = tmp_path / "odd.safetensors"
    path.write_bytes(repacked(field, meta={"format": "a\nb" * 5000}))
    with pytest.raises(CorruptFile) as caught:
        read_tensors(path, FORMAT)
    assert str(caught.value).isprintable()
    assert len(str(caught.value)) < len(str(path)) + 300


@given(place=st.floats(0, 1, exclude_max=True), value=st.integers(0, 255))
def test_a_flipped_byte_gives_a_field_or_a_refusal(field, place, value):
    data = bytearray(field_bytes(field))
    header = 8 + struct.unpack("<Q", bytes(data[:8]))[0]
    data[int(place * (header + 200))] = value  # headers break in more ways than numbers
    try:
        back = field_from_bytes(bytes(data), "it")
    except CorruptFile:
        return
    assert np.all(np.isfinite(back.rows))


TENSORS = ("origin", "voxel", "shape", "shell", "levels", "low", "span", "cells", "networks", "ambient")
# What is longer or deeper in these is ignored, or still fits.
HARMLESS = {"voxel", "networks", "cells", "shell"}
OTHER_KINDS = {
    **{"levels": (np.float32, np.int8, np.uint16), "cells": (np.float32,), "shape": (np.float64,), "shell": (np.int8,)},
    **{"origin": (np.int32,), "voxel": (np.int32,), "networks": (np.int16,), "ambient": (np.uint8,)},
}
BAD_VALUES = {
    **{"origin": (np.nan, np.inf, 1e30), "voxel": (np.nan, np.inf, 0.0, -0.1, 1e-12, 1e12), "low": (np.nan, 1e30)},
    **{"networks": (np.nan, np.inf), "cells": (-1, 12, 30_000)},
    **dict.fromkeys(("span", "ambient"), (np.nan, 1e30, -0.1)),
}


@pytest.mark.parametrize("name", TENSORS)
def test_missing_tensors_and_those_of_another_shape_kind_or_range_are_refused(field, name):
    tensor = load(field_bytes(field))[name]
    others = [None, tensor.reshape(-1)[0].reshape(()), tensor[:0]]
    if name not in HARMLESS:
        others += [np.concatenate([tensor, tensor]), tensor[..., None]]
    others += [tensor.astype(kind) for kind in OTHER_KINDS.get(name, ())]
    for value in BAD_VALUES.get(name, ()):
        others.append(tensor.copy())
        others[-1].reshape(-1)[0] = value
    refuse(*(repacked(field, **{name: other}) for other in others))


def test_grids_that_make_no_sense_are_refused_before_memory_is_taken(field):
    shapes = [(-3, 5, 5), (0, 5, 5), (1, 5, 5), (5, 5), (5,) * 4, (2**20, 2**20, 2**30), (2**32, 2**32, 2), (300,) * 3]
    refuse(*(repacked(field, shape=np.array(shape, np.int64)) for shape in shapes))


def test_shells_that_are_empty_or_touch_the_grids_faces_are_refused(field):
    refuse(field_bytes(replace(field, index=np.zeros_like(field.index), rows=field.rows[:1])))
    index = field.index.copy()
    index[0, 3, 3] = len(field.rows)
    refuse(field_bytes(replace(field, index=index, rows=np.concatenate([field.rows, field.rows[-1:]]))))


@pytest.mark.parametrize("hidden", [-1, 0, 7, 65, 300, "many"])
def test_networks_of_another_width_are_refused(field, hidden):
    """Also consistent ones beyond what the renderer has room for."""
    width = network_size(hidden) if isinstance(hidden, int) and hidden > 7 else network_size(HIDDEN)
    refuse(repacked(field, hidden=hidden, networks=np.zeros((12, width), np.float16)))
