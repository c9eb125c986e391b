"""Photographs that are drawn with known poses."""

import numpy as np
import pytest

from osfcore.errors import InvalidInput
from osfcore.experiments.drawn_photos import write_drawn_photos
from osfcore.experiments.photos import GROUND_TRUTH, read_scene
from tests.support.errors import about

SEED = 3


@pytest.fixture(scope="module")
def folder(library, tmp_path_factory):
    folder = tmp_path_factory.mktemp("drawn")
    write_drawn_photos(library, folder, SEED, count=1, views=2)
    return folder


def test_photographs_of_one_table_show_the_same_objects_from_other_places(folder):
    one, other = (read_scene(folder / name) for name in ("drawn_000", "drawn_000_1"))
    assert one.table == other.table == "drawn_000"
    apart = one.T_table_camera.position - other.T_table_camera.position
    assert np.linalg.norm(apart) > 0.1
    np.testing.assert_array_equal(one.photo.intrinsics, other.photo.intrinsics)
    both = one.photo.masks.keys() & other.photo.masks.keys()
    assert both
    for name in both:
        first, second = (scene.T_table_camera @ scene.poses[GROUND_TRUTH][name] for scene in (one, other))
        np.testing.assert_allclose(first.matrix(), second.matrix(), atol=1e-9)


def test_an_object_is_where_its_mask_is(folder):
    scene = read_scene(folder / "drawn_000")
    for name, pose in scene.reference.items():
        x, y = (scene.photo.intrinsics @ pose.position)[:2] / pose.position[2]
        rows, columns = np.nonzero(scene.photo.masks[name])
        assert columns.min() - 5 < x < columns.max() + 5
        assert rows.min() - 5 < y < rows.max() + 5


def test_more_photographs_of_a_table_do_not_change_the_first(library, folder, tmp_path):
    write_drawn_photos(library, tmp_path, SEED, count=1)
    for path in (tmp_path / "drawn_000").iterdir():
        if path.name != "photo.json":
            assert path.read_bytes() == (folder / "drawn_000" / path.name).read_bytes()
    assert read_scene(tmp_path / "drawn_000").table == "drawn_000"


@pytest.mark.parametrize(("count", "views", "what"), [(0, 1, "drawn photographs"), (1, 9, "photographs of a table")])
def test_absurd_numbers_are_refused(library, tmp_path, count, views, what):
    with pytest.raises(InvalidInput, check=about(what)):
        write_drawn_photos(library, tmp_path, SEED, count, views)
