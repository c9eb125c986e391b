import io
import json
import shutil
from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from PIL import Image

from osfcore.errors import CannotWrite, CorruptFile, InvalidInput, OsfError
from osfcore.geometry.cameras import Camera
from osfcore.geometry.states import Observation
from osfcore.io.observation_file import OBSERVATION_FILE, is_observation, read_observation, write_observation
from tests.support.errors import about
from tests.support.json_edits import edited, json_values_with
from tests.support.same import assert_same

NAMES = ("006_mustard_bottle", "035_power_drill")


def observation(views=2, names=NAMES, size=16, seed=0, masks=True, camera_names=("left", "right")) -> Observation:
    rng = np.random.default_rng(seed)
    cameras = tuple(
        Camera.look_at(name, (0.6, 0.1 * i, 0.5), (0, 0, 0), size=size)
        for i, name in zip(range(views), camera_names, strict=False)
    )
    images = (rng.integers(0, 256, (views, size, size, 3)) / 255).astype(np.float32)
    seen = rng.random((views, len(names), size, size)) > 0.8
    return Observation(cameras, images, names, seen if masks else None, np.array([0.1, 0.2, 0.062]), 1.5)


@given(data=st.data())
@settings(max_examples=30)
def test_an_observation_survives_its_folder(tmp_path_factory, data):
    labels = st.text(min_size=1, max_size=6)
    camera_names = data.draw(st.lists(labels, min_size=1, max_size=3, unique=True))
    names = tuple(data.draw(st.lists(labels, min_size=1, max_size=3, unique=True)))
    size, seed, masks = data.draw(st.tuples(st.integers(16, 24), st.integers(0, 99), st.booleans()))
    made = observation(len(camera_names), names, size, seed, masks, camera_names)
    if data.draw(st.booleans()):
        made = replace(made, pusher=None)
    if made.masks is not None and data.draw(st.booleans()):
        made.masks[0, 0] = False
    folder = tmp_path_factory.mktemp("observations") / "new"
    assert not is_observation(folder)
    write_observation(folder, made)
    assert is_observation(folder)
    assert_same(read_observation(folder), made, atol=1e-6)


def test_images_are_rounded_and_clipped_and_writing_again_leaves_no_mixture(tmp_path):
    images = np.random.default_rng(0).uniform(-0.2, 1.2, (2, 16, 16, 3))
    write_observation(tmp_path, replace(observation(), images=images))
    assert np.abs(read_observation(tmp_path).images - images.clip(0, 1)).max() <= 0.5 / 255 + 1e-6
    write_observation(tmp_path, observation(seed=1))
    assert_same(read_observation(tmp_path), observation(seed=1), atol=1e-6)
    (tmp_path / "image_1.png").unlink()
    (tmp_path / "image_1.png").mkdir()  # cannot be written over
    with pytest.raises(CannotWrite):
        write_observation(tmp_path, observation(seed=2))
    assert not is_observation(tmp_path)


@pytest.mark.parametrize(
    ("changes", "what"),
    [
        ({"images": np.zeros((2, 16, 17, 3))}, "images"),
        ({"masks": np.zeros((2, 1, 16, 16), bool)}, "masks"),
        ({"names": ("a", "a")}, "list of objects"),
        ({"cameras": observation(camera_names=("a", "a")).cameras}, "names of the cameras"),
        ({"pusher": np.array([np.inf, 0, 0])}, "pusher"),
        ({"time_s": float("nan")}, "time_s"),
    ],
)
def test_what_does_not_fit_is_not_written(tmp_path, changes, what):
    with pytest.raises(InvalidInput, check=about(what)):
        write_observation(tmp_path / "new", replace(observation(), **changes))
    assert not (tmp_path / "new").exists()


# Reading what others wrote


@pytest.fixture(scope="module")
def pristine(tmp_path_factory):
    folder = tmp_path_factory.mktemp("pristine") / "scene"
    write_observation(folder, observation())
    return folder


@pytest.fixture
def folder(pristine, tmp_path):
    return shutil.copytree(pristine, tmp_path / "scene")


def edit(folder, path, value):
    data = json.loads((folder / OBSERVATION_FILE).read_text())
    (folder / OBSERVATION_FILE).write_text(json.dumps(edited(data, path, value)))


def save(folder, name, pixels, mode=None):
    image = Image.fromarray(pixels)
    (image.convert(mode) if mode else image).save(folder / name)


def refused(folder, datum):
    """Refused in one line that begins with the file to blame."""
    with pytest.raises(CorruptFile, check=about(datum)) as caught:
        read_observation(folder)
    assert str(caught.value).startswith(str(folder))
    assert len(str(caught.value).splitlines()) == 1


def test_folders_without_an_observation_are_refused(tmp_path):
    (tmp_path / "file").write_text("")
    for path in (tmp_path, tmp_path / "nowhere", tmp_path / "file"):
        refused(path, str(path))
    for text in ("{", "[]"):
        (tmp_path / OBSERVATION_FILE).write_text(text)
        refused(tmp_path, OBSERVATION_FILE)


CAMERA = {"name": "left", "T_world_camera": np.eye(4).tolist(), "K": np.eye(3).tolist(), "width": 16, "height": 16}


@pytest.mark.parametrize(
    ("datum", "path", "values"),
    [
        ("cameras", ("cameras",), [[], ..., {"a": 1}, [CAMERA] * 33]),
        ("names of the cameras", ("cameras", 1, "name"), ["left"]),
        ("[px]", ("cameras", 1, "width"), [20, 5000]),
        ("K of camera right", ("cameras", 1, "K", 0, 0), [float("nan")]),
        ("T_world_camera of camera right", ("cameras", 1, "T_world_camera", 0, 3), [float("inf")]),
        ("images", ("images",), [..., ["image_0.png"]]),
        ("other", ("images", "other"), ["image_0.png"]),
        ("files of the images", ("images", "right"), ["image_0.png"]),
        ("image of camera right", ("images", "right"), [..., "no.png", 3, "", "a\0b", "\ud800.png", ".", "a" * 5000]),
        ("image of camera right", ("images", "right"), ["/etc/passwd", "../scene/image_1.png", "..\\image_1.png"]),
        ("objects", ("objects",), [[], [str(i) for i in range(9)], ..., ["a", "a"], [""], [1], [[]]]),
        ("masks", ("masks",), [[], {"left": []}]),
        ("other", ("masks", "other"), [{}]),
        ("spoon", ("masks", "left", "spoon"), ["mask_0_0.png"]),
        ("mask of 006_mustard_bottle for camera left", ("masks", "left", NAMES[0]), ["no.png", "../a.png"]),
        ("pusher", ("pusher",), [[0, 0, 0], {}]),
        ("position of pusher", ("pusher", "position"), [[0, 0, float("nan")], [0, 0]]),
        ("time_s", ("time_s",), [float("inf"), -1, "now", True]),
    ],
)  # fmt: skip
def test_mistakes_are_refused_with_their_place(folder, datum, path, values):
    sound = (folder / OBSERVATION_FILE).read_text()
    for value in values:
        (folder / OBSERVATION_FILE).write_text(sound)
        edit(folder, path, value)
        refused(folder, datum)


def test_what_may_be_missing_may_be_missing(folder):
    edit(folder, ("masks", "left", NAMES[0]), ...)
    edit(folder, ("masks", "right"), {NAMES[1]: None})  # nobody drew it
    read = read_observation(folder)
    assert read.masks.any(axis=(2, 3)).tolist() == [[False, True], [False, False]]
    assert read.unmasked.tolist() == [[False, False], [False, True]]
    write_observation(folder / "again", read)
    assert read_observation(folder / "again").unmasked.tolist() == read.unmasked.tolist()
    for key in ("masks", "pusher", "time_s"):
        edit(folder, (key,), ...)
    read = read_observation(folder)
    assert (read.masks, read.pusher, read.time_s) == (None, None, 0.0)


RGB = np.random.default_rng(0).integers(0, 256, (16, 16, 3), np.uint8)
GREY = RGB[..., 0].copy()


@pytest.mark.parametrize(
    ("file", "pixels", "mode"),
    [
        ("image_0.png", np.zeros((16, 17, 3), np.uint8), None),
        ("image_0.png", GREY, None),
        ("image_0.png", GREY.astype(np.uint16) * 200, None),
        ("image_0.png", RGB, "P"),
        ("image_0.png", RGB, "1"),
        ("image_0.png", np.dstack([RGB, GREY]), None),  # partly transparent
        ("mask_0_0.png", np.zeros((17, 16), np.uint8), None),
        ("mask_0_0.png", RGB, None),
        ("mask_0_0.png", GREY, "P"),
        ("mask_0_0.png", GREY, "LA"),
        ("mask_0_0.png", GREY.astype(np.uint16) * 200, None),
    ],
)
def test_images_and_masks_of_another_size_or_kind_are_refused(folder, file, pixels, mode):
    save(folder, file, pixels, mode)
    refused(folder, file)


def test_files_that_are_no_png_or_of_16_bits_are_refused(folder):
    data = bytearray((folder / "image_0.png").read_bytes())
    data[24] = 16
    buffer = io.BytesIO()
    Image.fromarray(RGB).save(buffer, "JPEG")
    for content in (data, b"", b"no picture", buffer.getvalue()):
        (folder / "image_0.png").write_bytes(content)
        refused(folder, "image_0.png")
    save(folder, "image_0.png", np.dstack([RGB, np.full_like(GREY, 255)]))  # opaque
    np.testing.assert_array_equal(np.round(read_observation(folder).images[0] * 255), RGB)


@pytest.mark.parametrize("mode", ["L", "1"])
def test_a_mask_is_what_is_above_the_middle(folder, mode):
    low, high = (127, 128) if mode == "L" else (0, 255)
    save(folder, "mask_0_0.png", np.where(GREY > 127, high, low).astype(np.uint8), mode)
    np.testing.assert_array_equal(read_observation(folder).masks[0, 0], GREY > 127)


def test_links_may_not_lead_out(folder, tmp_path):
    shutil.move(folder / "image_0.png", tmp_path / "elsewhere.png")
    for target in (tmp_path / "elsewhere.png", "image_0.png"):
        (folder / "image_0.png").unlink(missing_ok=True)
        (folder / "image_0.png").symlink_to(target)
        refused(folder, "camera left")


@given(
    key=st.sampled_from(["cameras", "images", "masks", "objects", "pusher", "time_s"]),
    value=json_values_with("left", "right", "position"),
)
@settings(max_examples=40)
def test_whatever_comes_it_is_an_observation_or_a_clear_error(pristine, tmp_path_factory, key, value):
    folder = shutil.copytree(pristine, tmp_path_factory.mktemp("strange") / "scene")
    edit(folder, (key,), value)
    try:
        read_observation(folder)
    except OsfError as error:
        assert len(str(error)) < 600
