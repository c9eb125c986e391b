import copy
import io
import json
import re
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


def assert_same(a: Observation, b: Observation):
    assert (a.names, a.time_s) == (b.names, b.time_s)
    np.testing.assert_allclose(a.images, b.images, atol=1e-6)
    assert (a.masks is None) == (b.masks is None)
    if a.masks is not None:
        assert a.masks.dtype == b.masks.dtype == bool
        np.testing.assert_array_equal(a.masks, b.masks)
    assert (a.pusher is None) == (b.pusher is None)
    if a.pusher is not None:
        np.testing.assert_allclose(a.pusher, b.pusher, atol=1e-12)
    assert [c.name for c in a.cameras] == [c.name for c in b.cameras]
    for mine, other in zip(a.cameras, b.cameras, strict=True):
        np.testing.assert_allclose(mine.T_world_camera.matrix(), other.T_world_camera.matrix(), atol=1e-9)
        np.testing.assert_allclose(mine.intrinsics, other.intrinsics, atol=1e-12)
        assert (mine.width, mine.height) == (other.width, other.height)


@given(data=st.data())
@settings(max_examples=30)
def test_an_observation_survives_its_folder(tmp_path_factory, data):
    labels = st.text(min_size=1, max_size=6)
    camera_names = data.draw(st.lists(labels, min_size=1, max_size=3, unique=True))
    names = tuple(data.draw(st.lists(labels, min_size=1, max_size=3, unique=True)))
    made = observation(
        len(camera_names),
        names,
        data.draw(st.integers(16, 24)),
        data.draw(st.integers(0, 99)),
        data.draw(st.booleans()),
        camera_names,
    )
    if data.draw(st.booleans()):
        made = replace(made, pusher=None)
    if made.masks is not None and data.draw(st.booleans()):
        made.masks[0, 0] = False
    folder = tmp_path_factory.mktemp("observations") / "new"
    assert not is_observation(folder)
    write_observation(folder, made)
    assert is_observation(folder)
    assert_same(read_observation(folder), made)


def test_images_are_rounded_to_8_bits_and_clipped(tmp_path):
    made = observation(1)
    images = np.random.default_rng(0).uniform(-0.2, 1.2, made.images.shape)
    write_observation(tmp_path, replace(made, images=images))
    assert np.abs(read_observation(tmp_path).images - images.clip(0, 1)).max() <= 0.5 / 255 + 1e-6


def test_black_images_and_masks_without_a_pixel_are_what_they_are(tmp_path):
    made = observation()
    made.images[:] = 0
    made.masks[:] = False
    write_observation(tmp_path, made)
    assert_same(read_observation(tmp_path), made)


def test_writing_again_leaves_no_mixture(tmp_path, monkeypatch):
    write_observation(tmp_path, observation())
    write_observation(tmp_path, observation(seed=1))
    assert_same(read_observation(tmp_path), observation(seed=1))

    def full(self, data):
        raise OSError(28, "No space left on device")

    monkeypatch.setattr("pathlib.Path.write_bytes", full)
    with pytest.raises(CannotWrite, match="No space left"):
        write_observation(tmp_path, observation(seed=2))
    assert not is_observation(tmp_path)


@pytest.mark.parametrize(
    ("changes", "words"),
    [
        ({"images": np.zeros((2, 16, 17, 3))}, "shape of the images"),
        ({"images": np.full((2, 16, 16, 3), np.nan)}, "finite"),
        ({"masks": np.zeros((2, 1, 16, 16), bool)}, "shape of the masks"),
        ({"names": ()}, "number of objects is 0"),
        ({"names": ("a", "a")}, "without repetition"),
        ({"cameras": ()}, "number of cameras is 0"),
        ({"cameras": observation(camera_names=("a", "a")).cameras}, "all different"),
        ({"pusher": np.array([np.inf, 0, 0])}, "pusher"),
        ({"time_s": float("nan")}, "time_s"),
    ],
)
def test_what_does_not_fit_is_not_written(tmp_path, changes, words):
    with pytest.raises(InvalidInput, match=words):
        write_observation(tmp_path / "new", replace(observation(), **changes))
    assert not (tmp_path / "new").exists()


def test_a_place_that_cannot_be_written_is_told(tmp_path):
    (tmp_path / "file").write_text("")
    with pytest.raises(CannotWrite):
        write_observation(tmp_path / "file" / "new", observation())


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
    """Set an entry of observation.json, or remove it where the value is `...`."""
    data = json.loads((folder / OBSERVATION_FILE).read_text())
    at = data
    for key in path[:-1]:
        at = at[key]
    if value is ...:
        del at[path[-1]]
    else:
        at[path[-1]] = copy.deepcopy(value)
    (folder / OBSERVATION_FILE).write_text(json.dumps(data))


def save(folder, name, pixels, mode=None, **options):
    image = Image.fromarray(pixels)
    (image.convert(mode) if mode else image).save(folder / name, **options)


def refused(folder, words):
    """One sentence with the file that is to blame."""
    with pytest.raises(CorruptFile, match=words) as caught:
        read_observation(folder)
    assert str(caught.value).startswith(str(folder))
    assert len(str(caught.value).splitlines()) == 1


def test_folders_without_an_observation_are_told(tmp_path):
    refused(tmp_path, "no folder with an observation.json")
    refused(tmp_path / "nowhere", "no folder with an observation.json")
    (tmp_path / "file").write_text("")
    refused(tmp_path / "file", "no folder with an observation.json")
    (tmp_path / OBSERVATION_FILE).write_text("{")
    refused(tmp_path, "observation.json cannot be used: it is not valid JSON")
    (tmp_path / OBSERVATION_FILE).write_text("[]")
    refused(tmp_path, "observation is .*a JSON object")


CAMERA = json.loads(json.dumps({"name": "left", "T_world_camera": np.eye(4).tolist(), "K": np.eye(3).tolist()}))


@pytest.mark.parametrize(
    ("path", "value", "words"),
    [
        (("cameras",), [], "number of cameras is 0"),
        (("cameras",), ..., "'cameras' of observation is missing"),
        (("cameras",), {"a": 1}, "cameras is .*must be a list"),
        (("cameras",), [{**CAMERA, "width": 16, "height": 16}] * 33, "number of cameras is 33"),
        (("cameras", 1, "name"), "left", "names of the cameras is left, left"),
        (("cameras", 1, "width"), 20, "sizes of the cameras .px. is 16 x 16, 20 x 16"),
        (("cameras", 1, "width"), 5000, "width of camera right .px. is 5000"),
        (("cameras", 1, "K", 0, 0), float("nan"), "K of camera right"),
        (("cameras", 1, "T_world_camera", 0, 3), float("inf"), "T_world_camera of camera right"),
        (("images",), ..., "'images' of observation is missing"),
        (("images",), ["image_0.png"], "images is .*a JSON object"),
        (("images", "right"), ..., "image of camera right is missing"),
        (("images", "other"), "image_0.png", "no camera named 'other'; known: left, right"),
        (("images", "right"), "image_0.png", "files of the images is image_0.png, image_0.png"),
        (("images", "right"), "nothing.png", "nothing.png cannot be used: there is no such file, but"),
        (("images", "right"), 3, "image of camera right is 3"),
        (("images", "right"), "", "image of camera right is ''"),
        (("images", "right"), "a\0b", "image of camera right is"),
        (("images", "right"), "\ud800.png", "image of camera right is"),
        (("images", "right"), "/etc/passwd", "image of camera right is '/etc/passwd'.*without '..'"),
        (("images", "right"), "../scene/image_1.png", "without '..'"),
        (("images", "right"), "..\\scene\\image_1.png", "without '..'"),
        (("images", "right"), ".", "no such file"),
        (("images", "right"), "a" * 5000, "no such file"),
        (("objects",), [], "number of objects is 0"),
        (("objects",), [str(i) for i in range(9)], "number of objects is 9"),
        (("objects",), ..., "'objects' of observation is missing"),
        (("objects",), ["a", "a"], "list of objects is a, a"),
        (("objects",), [1], "objects.* is .*a text"),
        (("objects",), [[]], "objects.* is .*a text"),
        (("masks",), [], "masks is .*a JSON object"),
        (("masks", "other"), {}, "no camera named 'other'"),
        (("masks", "left", "spoon"), "mask_0_0.png", "no object named 'spoon'"),
        (("masks", "left"), [], "left of masks is .*a JSON object"),
        (("masks", "left", NAMES[0]), "no.png", "no.png cannot be used: .*mask of 006_mustard_bottle for camera left"),
        (("masks", "left", NAMES[0]), "../a.png", "mask of 006_mustard_bottle for camera left is"),
        (("pusher",), [0, 0, 0], "pusher is .*a JSON object"),
        (("pusher",), {}, "'position' of pusher is missing"),
        (("pusher", "position"), [0, 0, float("nan")], "position of pusher"),
        (("pusher", "position"), [0, 0], "position of pusher"),
        (("time_s",), float("inf"), "time_s is inf"),
        (("time_s",), -1, "time_s is -1"),
        (("time_s",), "now", "time_s is 'now'"),
        (("time_s",), True, "time_s is True"),
    ],
)  # fmt: skip
def test_mistakes_are_told_with_their_place(folder, path, value, words):
    edit(folder, path, value)
    refused(folder, words)


def test_what_may_be_missing_may_be_missing(folder):
    for path, value in ((("masks",), ...), (("pusher",), ...), (("time_s",), ...)):
        edit(folder, path, value)
    read = read_observation(folder)
    assert (read.masks, read.pusher, read.time_s) == (None, None, 0.0)


def test_a_mask_that_is_missing_is_empty(folder):
    edit(folder, ("masks", "left", NAMES[0]), ...)
    edit(folder, ("masks", "right"), ...)
    masks = read_observation(folder).masks
    assert not masks[0, 0].any()
    assert masks[0, 1].any()
    assert not masks[1].any()


RGB = np.random.default_rng(0).integers(0, 256, (16, 16, 3), np.uint8)
GREY = RGB[..., 0].copy()


@pytest.mark.parametrize(
    ("pixels", "mode", "words"),
    [
        (np.zeros((16, 17, 3), np.uint8), None, "it is 17 x 16 px; 16 x 16 px as camera left is expected"),
        (np.zeros((2000, 16, 3), np.uint8), None, "it is 16 x 2000 px"),
        (GREY, None, "8 bits and colour type 0 of PNG; 8-bit RGB is expected"),
        (GREY.astype(np.uint16) * 200, None, "16 bits and colour type 0"),
        (RGB, "P", "colour type 3"),
        (RGB, "1", "1 bits and colour type 0"),
        (np.dstack([RGB, GREY]), None, "partly transparent"),
    ],
)
def test_images_of_another_size_or_kind_are_told(folder, pixels, mode, words):
    save(folder, "image_0.png", pixels, mode)
    refused(folder, f"image_0.png cannot be used: .*{words}")


def test_opaque_rgba_is_rgb(folder):
    save(folder, "image_0.png", np.dstack([RGB, np.full_like(GREY, 255)]))
    np.testing.assert_array_equal(np.round(read_observation(folder).images[0] * 255), RGB)


def test_rgb_of_16_bits_is_refused(folder):
    data = bytearray((folder / "image_0.png").read_bytes())
    data[24] = 16
    (folder / "image_0.png").write_bytes(data)
    refused(folder, "16 bits and colour type 2 of PNG; 8-bit RGB is expected")


@pytest.mark.parametrize(
    ("pixels", "mode", "words"),
    [
        (np.zeros((17, 16), np.uint8), None, "it is 16 x 17 px; 16 x 16 px as camera left is expected"),
        (RGB, None, "colour type 2 of PNG; 8-bit grey"),
        (GREY, "P", "colour type 3"),
        (GREY, "LA", "colour type 4"),
        (GREY.astype(np.uint16) * 200, None, "16 bits"),
    ],
)
def test_masks_of_another_size_or_kind_are_told(folder, pixels, mode, words):
    save(folder, "mask_0_0.png", pixels, mode)
    refused(folder, f"mask_0_0.png cannot be used: .*{words}")


@pytest.mark.parametrize("mode", ["L", "1"])
def test_a_mask_is_what_is_above_the_middle(folder, mode):
    grey = np.where(GREY > 127, 128, 127).astype(np.uint8) if mode == "L" else np.where(GREY > 127, 255, 0)
    image = Image.fromarray(grey.astype(np.uint8))
    image.convert(mode).save(folder / "mask_0_0.png")
    np.testing.assert_array_equal(read_observation(folder).masks[0, 0], GREY > 127)


def test_links_may_not_lead_out(folder, tmp_path):
    shutil.move(folder / "image_0.png", tmp_path / "elsewhere.png")
    (folder / "image_0.png").symlink_to(tmp_path / "elsewhere.png")
    refused(folder, "not a link that leads out of it")
    (folder / "image_0.png").unlink()
    (folder / "image_0.png").symlink_to("image_0.png")
    refused(folder, "image_0.png cannot be used|no such file")


def test_other_files_are_no_png(folder):
    buffer = io.BytesIO()
    Image.fromarray(RGB).save(buffer, "JPEG")
    for content in (b"", b"no picture", buffer.getvalue()):
        (folder / "image_0.png").write_bytes(content)
        refused(folder, "image_0.png cannot be used: it is no PNG")


@given(share=st.floats(0, 1), damage=st.none() | st.integers(0, 255))
def test_a_damaged_png_is_read_as_it_was_or_told(pristine, tmp_path_factory, share, damage):
    folder = shutil.copytree(pristine, tmp_path_factory.mktemp("damaged") / "scene")
    data = bytearray((folder / "image_1.png").read_bytes())
    at = int(share * (len(data) - 1))
    data = data[:at] if damage is None else data[:at] + bytes([damage]) + data[at + 1 :]
    (folder / "image_1.png").write_bytes(data)
    try:
        images = read_observation(folder).images
    except CorruptFile as error:
        assert re.search(r"image_1.png cannot be used: it (is no|has \d+ bits|is \d+ x)", str(error))
    else:
        assert images.shape == (2, 16, 16, 3)
        if damage is None:
            np.testing.assert_allclose(images, observation().images, atol=1e-6)


json_values = st.recursive(
    st.none() | st.booleans() | st.floats(allow_nan=True) | st.integers() | st.text(max_size=5),
    lambda inner: st.lists(inner, max_size=3) | st.dictionaries(st.sampled_from(["left", "right", "position"]), inner),
    max_leaves=8,
)


@given(key=st.sampled_from(["cameras", "images", "masks", "objects", "pusher", "time_s"]), value=json_values)
def test_whatever_comes_it_is_an_observation_or_a_clear_error(pristine, tmp_path_factory, key, value):
    folder = shutil.copytree(pristine, tmp_path_factory.mktemp("strange") / "scene")
    edit(folder, (key,), value)
    try:
        read_observation(folder)
    except OsfError as error:
        assert len(str(error)) < 600
