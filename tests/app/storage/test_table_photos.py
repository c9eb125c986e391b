from dataclasses import replace

import numpy as np
import pytest

from app.processes.messages.photo_messages import Mark, Stroke
from app.storage.table_photos import MarkedObject, TablePhoto, TablePhotoStore, TooManyPhotos, mask_file
from osfcore.errors import UnknownName
from osfcore.geometry.poses import Pose
from tests.support.errors import about

K = np.array([[600.0, 0, 320], [0, 610.0, 240], [0, 0, 1]])
MUG = MarkedObject(
    "025_mug",
    Mark((10.0, 20.0, 110.0, 140.0), ((60.0, 80.0),), ((12.0, 22.0),), (Stroke(True, 5.0, ((1.0, 2.0), (3.0, 4.0))),)),
    (((10.0, 20.0), (110.0, 20.0), (60.0, 140.0)),),
)
BOARD = Pose(np.array([0.1, -0.4, 0.5]), np.array([0.6, 0.8, 0.0, 0.0]))


def record(name="p1", **changes):
    photo = TablePhoto(
        name, "My table", "2026-01-01T00:00:00Z", 640, 480, 1280, K, "board", BOARD, ("A note.",), (MUG,)
    )
    return replace(photo, **changes)


@pytest.fixture
def store(tmp_path):
    return TablePhotoStore(tmp_path / "photos", 2)


def test_a_photo_is_read_as_it_was_kept(store):
    kept = record(job="j", scene="s", T_table_photo=BOARD)
    store.keep(kept, b"sent", b"shown")
    read = store.get("p1")
    assert read.objects == kept.objects
    assert (read.source, read.notes, read.job, read.scene) == ("board", ("A note.",), "j", "s")
    np.testing.assert_array_equal(read.K, K)
    for pose in (read.T_world_camera, read.T_table_photo):
        np.testing.assert_allclose(pose.matrix(), BOARD.matrix(), atol=1e-12)
    assert (store.sent("p1").read_bytes(), store.picture("p1").read_bytes()) == (b"sent", b"shown")


def test_a_photo_without_a_board_has_no_pose(store):
    store.keep(record(T_world_camera=None, source="assumed", objects=()), b"", b"")
    assert store.get("p1").T_world_camera is None


def test_other_facts_take_the_place_of_those_before_with_files(store):
    store.keep(record(objects=()), b"", b"")
    with_choice = (replace(MUG, choice=2),)
    files = {mask_file(MUG.name): b"png"}
    store.change("p1", lambda latest: replace(latest, objects=with_choice), files)
    assert store.get("p1").marked(MUG.name).choice == 2
    assert store.mask("p1", MUG.name).read_bytes() == b"png"


def test_only_so_many_are_kept_and_one_may_go(store):
    for name in ("p1", "p2"):
        store.keep(record(name), b"", b"")
    with pytest.raises(TooManyPhotos):
        store.keep(record("p3"), b"", b"")
    store.remove("p1")
    assert [photo.id for photo in store.all()] == ["p2"]
    with pytest.raises(UnknownName, check=about("photo")):
        store.get("p1")


def test_a_damaged_photo_does_not_hide_the_others(store):
    for name in ("p1", "p2"):
        store.keep(record(name), b"", b"")
    (store.picture("p1").parent / "photo.json").write_text("{")
    assert [photo.id for photo in store.all()] == ["p2"]


def test_an_object_marked_again_keeps_its_place_among_the_others():
    other = replace(MUG, name="024_bowl")
    photo = record(objects=(MUG, other)).with_object(replace(MUG, outline=()))
    assert [entry.name for entry in photo.objects] == ["025_mug", "024_bowl"]
    assert photo.marked("025_mug").outline == ()
    with pytest.raises(UnknownName, check=about("003_cracker_box")):
        photo.marked("003_cracker_box")


def test_a_smaller_picture_has_the_camera_of_the_photo():
    camera = record().camera(BOARD, 320)
    assert (camera.width, camera.height) == (320, 240)
    np.testing.assert_allclose(camera.intrinsics, [[300, 0, 160], [0, 305, 120], [0, 0, 1]], atol=1e-12)
