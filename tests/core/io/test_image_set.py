import json
import os
import shutil
import struct

import cv2
import numpy as np
import pytest

import osfcore.io.image_set as module
from osfcore.errors import CorruptFile
from osfcore.io.image_set import read_annotations, read_image_set, read_splits
from osfcore.world.collect_images import CollectTable, collect_table
from tests.core.fields.sets import edit


@pytest.fixture(scope="module")
def table_set(tmp_path_factory):
    out = tmp_path_factory.mktemp("sets") / "table"
    list(collect_table(CollectTable(out, images=60, size=16)))
    return out


def pixels(path) -> np.ndarray:
    return np.asarray(cv2.imread(str(path), cv2.IMREAD_UNCHANGED))


def test_public_sets_are_read_whatever_their_unit_lights_and_further_keys(image_set):
    train, test = read_splits(image_set)
    assert train.rgba.shape == (12, 32, 32, 4)
    assert test.rgba.shape == (4, 32, 32, 4)
    assert train.rgba.dtype == np.uint8
    assert not train.is_opaque
    assert train.light_directions.dtype == np.float32
    np.testing.assert_allclose(np.linalg.norm(train.light_directions, axis=1), 1, atol=1e-6)
    entries = json.loads((image_set / "train" / "anno.json").read_text())
    np.testing.assert_allclose(train.light_directions[5], np.array(entries[5]["light_pos"]) / 15, atol=1e-6)
    for camera in train.cameras:
        assert np.linalg.norm(camera.T_world_camera.position) == pytest.approx(2.5)
    assert train.cameras[2].name == "train/r_2.png"
    bgra = pixels(image_set / "train" / "r_2.png")
    np.testing.assert_array_equal(train.rgba[2], bgra[..., [2, 1, 0, 3]])


def test_val_may_be_broken_or_missing(image_set):
    (image_set / "val" / "anno.json").write_text("nonsense")
    read_splits(image_set)
    shutil.rmtree(image_set / "val")
    read_splits(image_set)


def test_annotations_carry_the_paths_of_the_images(image_set):
    images = read_annotations(image_set, "test")
    assert [image.path for image in images] == [image_set / "test" / f"r_{i}.png" for i in range(4)]


def test_resolution_is_optional_and_may_be_a_pair(image_set):
    edit(image_set, lambda e: e.pop("resolution"))
    edit(image_set, lambda e: e.update(resolution=[32, 32]), number=4)
    assert len(read_annotations(image_set, "train")) == 12


def test_images_may_lie_in_folders_beside_the_annotations(image_set):
    (image_set / "train" / "rgba").mkdir()
    (image_set / "train" / "r_3.png").rename(image_set / "train" / "rgba" / "a.png")
    edit(image_set, lambda e: e.update(filename="rgba/a.png"))
    assert read_image_set(image_set, "train").cameras[3].name == "train/rgba/a.png"


def test_the_bare_table_is_opaque(table_set):
    train, test = read_splits(table_set)
    assert train.is_opaque
    assert test.is_opaque


@pytest.mark.parametrize(
    ("change", "words"),
    [
        (lambda e: e.pop("light_pos"), r"anno.json.*entry 3 \(r_3.png\) lacks or garbles light_pos; 3 finite"),
        (lambda e: e.update(light_pos=[0, 0, 0]), "light_pos of entry 3.*no direction; a vector toward the light"),
        (lambda e: e.update(light_pos=[np.nan, 0, 1]), "light_pos of entry 3.*not finite"),
        (lambda e: e.update(light_pos=[10**400, 0, 0]), "entry 3.*garbles light_pos"),
        (lambda e: e.update(light_pos="up"), "entry 3.*garbles light_pos"),
        (lambda e: e["RT"][1].__setitem__(3, np.nan), "RT of entry 3.*not finite"),
        (lambda e: e["RT"][1].__setitem__(0, np.inf), "RT of entry 3.*not finite"),
        (lambda e: e["RT"][1].__setitem__(3, 1e300), "RT of entry 3.*too large"),
        (lambda e: e.update(RT=(2 * np.eye(3, 4)).tolist()), "RT of entry 3.*rotation; expected is world-to-camera"),
        (lambda e: e.update(RT=np.diag([1.0, 1, -1, 0])[:3].tolist()), "RT of entry 3.*rotation"),
        (lambda e: e.update(RT=np.zeros((3, 4)).tolist()), "RT of entry 3.*rotation"),
        (lambda e: e.update(RT=np.eye(4).tolist()), "garbles RT; 3 x 4"),
        (lambda e: e.update(K=np.zeros((3, 3)).tolist()), "K of camera train/r_3.png.*focal"),
        (lambda e: e.pop("K"), "garbles K; 3 x 3"),
        (lambda e: e.update(resolution=64), r"r_3.png.*it is 32 x 32 px, but resolution of entry 3 says 64 x 64"),
        (lambda e: e.update(resolution=[32, 16]), "says 32 x 16"),
        (lambda e: e.update(resolution="large"), "resolution of entry 3 is not one side"),
        (lambda e: e.update(filename="gone.png"), "train/gone.png.*no readable PNG.*entry 3"),
        (lambda e: e.update(filename="r_4.png"), "entries 3 and 4 name the same image r_4.png"),
        (lambda e: e.pop("filename"), "entry 3 lacks or garbles filename"),
        (lambda e: e.update(filename=7), "entry 3 lacks or garbles filename"),
        (lambda e: e.update(filename="a\0.png"), "entry 3 lacks or garbles filename"),
        (lambda e: e.update(filename="x" * 5000), "no readable PNG"),
        (lambda e: e.update(filename="r_3\ud800.png"), "entry 3 lacks or garbles filename"),
        (lambda e: e.update(filename="r_\udc80.png"), "entry 3 lacks or garbles filename"),
        (lambda e: e.update(resolution=[10**4000, 32]), "resolution of entry 3 says 1000.*000 x 32"),
        (lambda e: e.update(filename="../test/r_1.png"), "entry 3 names '../test/r_1.png'; .*without '..'"),
        (lambda e: e.update(filename="/etc/passwd"), "entry 3 names '/etc/passwd'; .*relative to anno.json"),
    ],
)
def test_broken_entries_are_told_with_their_place(image_set, change, words):
    edit(image_set, change)
    with pytest.raises(CorruptFile, match=words):
        read_splits(image_set)


@pytest.mark.parametrize("name", ["\x1b[31mred\n.png", "x" * 5000, "../" + "\n" * 5000, "y/" * 3000 + "\t.png"])
@pytest.mark.parametrize("change", [{}, {"light_pos": "up"}])
def test_long_and_unprintable_names_are_told_in_one_short_line(image_set, name, change):
    edit(image_set, lambda e: e.update(filename=name, **change))
    with pytest.raises(CorruptFile) as caught:
        read_splits(image_set)
    assert str(caught.value).isprintable()
    assert len(str(caught.value)) < len(str(image_set)) + 350


def test_names_that_are_used_twice_are_told_in_one_short_line(image_set):
    name = "./" * 500 + "r_4\n.png"
    (image_set / "train" / "r_4.png").rename(image_set / "train" / "r_4\n.png")
    edit(image_set, lambda e: e.update(filename=name))
    edit(image_set, lambda e: e.update(filename=name), number=4)
    with pytest.raises(CorruptFile, match="entries 3 and 4 name the same image") as caught:
        read_splits(image_set)
    assert str(caught.value).isprintable()
    assert len(str(caught.value)) < len(str(image_set)) + 350


def test_digests_tell_sets_apart(image_set):
    digests = {read_image_set(image_set, "train").digest()}
    assert read_image_set(image_set, "train").digest() in digests
    for number, change in enumerate(
        (
            lambda e: e.update(light_pos=[0, 0, 1]),
            lambda e: e["RT"][0].__setitem__(3, e["RT"][0][3] + 1e-3),
            lambda e: e["K"][0].__setitem__(2, 15.0),
        )
    ):
        edit(image_set, change)
        digests.add(read_image_set(image_set, "train").digest())
        assert len(digests) == number + 2
    bgra = pixels(image_set / "train" / "r_3.png")
    bgra[16, 16, 0] ^= 1
    cv2.imwrite(str(image_set / "train" / "r_3.png"), bgra)
    digests.add(read_image_set(image_set, "train").digest())
    assert len(digests) == 5


def test_entries_that_are_no_objects_are_told(image_set):
    path = image_set / "train" / "anno.json"
    path.write_text(json.dumps([*json.loads(path.read_text()), 7]))
    with pytest.raises(CorruptFile, match="entry 12 is not an object"):
        read_splits(image_set)


def test_links_out_of_the_set_are_refused_and_links_inside_are_not(image_set, tmp_path):
    image = image_set / "train" / "r_3.png"
    image.rename(image_set / "kept.png")
    image.symlink_to(image_set / "kept.png")
    read_splits(image_set)
    shutil.move(image_set / "kept.png", tmp_path / "secret.png")
    image.unlink()
    image.symlink_to(tmp_path / "secret.png")
    with pytest.raises(CorruptFile, match="entry 3 names 'r_3.png', a link that leads out of the set"):
        read_splits(image_set)
    image.unlink()
    image.symlink_to(image)
    with pytest.raises(CorruptFile, match="r_3.png"):
        read_splits(image_set)


def test_what_is_no_plain_file_is_not_waited_for(image_set):
    (image_set / "train" / "r_3.png").unlink()
    os.mkfifo(image_set / "train" / "r_3.png")
    with pytest.raises(CorruptFile, match="no readable PNG"):
        read_splits(image_set)


@pytest.mark.parametrize("share", [0.0, 0.02, 0.5, 0.9])
def test_truncated_images_are_told(image_set, share):
    path = image_set / "test" / "r_1.png"
    path.write_bytes(path.read_bytes()[: int(share * path.stat().st_size)])
    with pytest.raises(CorruptFile, match="test/r_1.png cannot be used: it is no readable PNG: truncated"):
        read_splits(image_set)


def test_damaged_images_of_any_kind_are_told(image_set):
    path = image_set / "test" / "r_1.png"
    sound = path.read_bytes()
    rng = np.random.default_rng(0)
    told = 0
    for _ in range(200):
        data = bytearray(sound)
        for place in rng.integers(8, len(data), 3):
            data[place] = rng.integers(256)
        path.write_bytes(data)
        try:
            read_splits(image_set)
        except CorruptFile:
            told += 1
    assert told > 150  # a few changes hit nothing that matters


def test_huge_images_are_refused_from_their_header(image_set):
    path = image_set / "test" / "r_1.png"
    cv2.imwrite(str(path), np.zeros((2000, 2000, 4), np.uint8))
    with pytest.raises(CorruptFile, match=r"r_1.png.*2000 x 2000 px; sides from 16 to 1024"):
        read_splits(image_set)


@pytest.mark.parametrize("side", [10_000, 60_000])
def test_images_that_would_fill_the_memory_are_refused_by_their_size(image_set, side):
    path = image_set / "test" / "r_1.png"
    data = path.read_bytes()
    path.write_bytes(data[:16] + struct.pack(">II", side, side) + data[24:])
    with pytest.raises(CorruptFile, match=rf"r_1.png.*{side} x {side} px; sides from 16 to 1024"):
        read_splits(image_set)


def test_images_without_transparency_are_refused(image_set):
    cv2.imwrite(str(image_set / "test" / "r_0.png"), np.zeros((32, 32, 3), np.uint8))
    with pytest.raises(CorruptFile, match=r"r_0.png.*8-bit RGBA is expected"):
        read_splits(image_set)


def test_all_images_of_a_set_have_one_size(image_set):
    path = image_set / "train" / "r_3.png"
    cv2.imwrite(str(path), cv2.resize(pixels(path), (48, 48)))
    edit(image_set, lambda e: e.update(resolution=48))
    with pytest.raises(CorruptFile, match=r"r_3.png.*48 x 48 px, not 32 x 32 px as r_0.png is"):
        read_splits(image_set)


def test_both_splits_have_one_size(image_set):
    edit(image_set, lambda e: e.update(resolution=48), "test", None)
    for path in (image_set / "test").glob("*.png"):
        cv2.imwrite(str(path), cv2.resize(pixels(path), (48, 48)))
    with pytest.raises(CorruptFile, match="train images are 32 x 32 px and test images 48 x 48 px"):
        read_splits(image_set)


def test_empty_masks_are_told(image_set):
    path = image_set / "train" / "r_6.png"
    bgra = pixels(path)
    bgra[..., 3] = 0
    cv2.imwrite(str(path), bgra)
    with pytest.raises(CorruptFile, match=r"train/r_6.png.*its mask is empty: it has no opaque pixel"):
        read_splits(image_set)


def test_an_image_that_lost_its_silhouette_is_told(image_set):
    path = image_set / "train" / "r_6.png"
    bgra = pixels(path)
    bgra[..., 3] = 255
    cv2.imwrite(str(path), bgra)
    with pytest.raises(CorruptFile, match=r"train/r_6.png.*1 of 12 images are opaque all over; either all"):
        read_splits(image_set)


def test_an_object_to_train_on_and_a_table_to_test_on_is_told(image_set):
    for path in (image_set / "test").glob("*.png"):
        bgra = pixels(path)
        bgra[..., 3] = 255
        cv2.imwrite(str(path), bgra)
    with pytest.raises(CorruptFile, match="only one of train and test has transparent pixels"):
        read_splits(image_set)


@pytest.mark.parametrize(("count", "words"), [(1, "1 image; between 8 and"), (7, "7 images; between 8 and")])
def test_sets_with_too_few_images_are_told(image_set, count, words):
    path = image_set / "train" / "anno.json"
    path.write_text(json.dumps(json.loads(path.read_text())[:count]))
    with pytest.raises(CorruptFile, match=f"train/anno.json.*it lists {words} 20000 are expected for train"):
        read_splits(image_set)


def test_missing_and_empty_splits_are_told(image_set):
    (image_set / "test" / "anno.json").write_text("[]")
    with pytest.raises(CorruptFile, match=r"test/anno.json.*not a list of images"):
        read_splits(image_set)
    shutil.rmtree(image_set / "test")
    with pytest.raises(CorruptFile, match="no readable test/anno.json; an image set holds train/anno.json and test"):
        read_splits(image_set)


@pytest.mark.parametrize("text", ["[" * 100_000, "{", "\xff", '{"a": 1}'])
def test_annotations_that_are_no_list_are_refused(image_set, text):
    (image_set / "train" / "anno.json").write_text(text, encoding="latin-1")
    with pytest.raises(CorruptFile, match=r"train/anno.json.*(not valid JSON|not a list)"):
        read_splits(image_set)


def test_huge_annotations_and_sets_are_refused_before_they_fill_the_memory(image_set, monkeypatch):
    monkeypatch.setattr(module, "MAX_SPLIT_BYTES", 12 * 32 * 32 * 4 - 1)
    with pytest.raises(CorruptFile, match="its 12 images of 32 x 32 px are too many"):
        read_splits(image_set)
    monkeypatch.setattr(module, "MAX_ANNOTATION_BYTES", 1000)
    with pytest.raises(CorruptFile, match="larger than"):
        read_splits(image_set)


def test_a_test_image_that_is_a_training_one_is_told_even_if_encoded_anew(image_set):
    bgra = pixels(image_set / "train" / "r_2.png")
    cv2.imwrite(str(image_set / "test" / "r_1.png"), bgra, [cv2.IMWRITE_PNG_COMPRESSION, 0])
    assert (image_set / "test" / "r_1.png").read_bytes() != (image_set / "train" / "r_2.png").read_bytes()
    with pytest.raises(CorruptFile, match=r"1 of 4 test images are also training images: test/r_1.png is train/r_2"):
        read_splits(image_set)


def test_a_table_seen_twice_under_equal_lights_is_no_leak_but_a_copy_is(table_set, tmp_path):
    copy = shutil.copytree(table_set, tmp_path / "table")
    shutil.copyfile(copy / "train" / "0004.png", copy / "test" / "0007.png")
    read_splits(copy)
    entry = json.loads((copy / "train" / "anno.json").read_text())[4]
    edit(copy, lambda e: e.update({**entry, "filename": e["filename"]}), "test", 7)
    with pytest.raises(CorruptFile, match="1 of 40 test images are also training images"):
        read_splits(copy)
