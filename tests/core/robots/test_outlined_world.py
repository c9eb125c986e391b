import contextlib

import numpy as np
import pytest

from osfcore.errors import InvalidInput, UnknownName
from osfcore.robots.guarded_world import OutlinedWorld
from tests.core.robots.robots import NAMES, simulated


@pytest.fixture(scope="module")
def table(library):
    with contextlib.closing(simulated(library, size=256)) as table:
        yield table


class Bare:
    """The table, which keeps its masks for itself."""

    def __init__(self, table):
        self.act, self.reset, self.close, self._table = table.act, table.reset, table.close, table

    def observe(self, *, masks=False):
        return self._table.observe()


def boxes_around(seen, cameras, names=NAMES, margin=6):
    boxes = {}
    for view in cameras:
        for name in names:
            rows, columns = np.nonzero(seen.masks[view, seen.names.index(name)])
            box = columns.min() - margin, rows.min() - margin, columns.max() + margin, rows.max() + margin
            boxes.setdefault(seen.cameras[view].name, {})[name] = tuple(map(float, box))
    return boxes


def test_boxes_become_masks_of_the_cameras_that_have_them_all(table):
    seen = table.observe(masks=True)
    boxes = boxes_around(seen, (1, 3)) | boxes_around(seen, (0,), NAMES[:1])
    world = OutlinedWorld(Bare(table), boxes)
    found = world.observe(masks=True)
    assert [camera.name for camera in found.cameras] == ["1", "3"]
    true = seen.masks[[1, 3]]
    iou = (found.masks & true).sum(axis=(2, 3)) / (found.masks | true).sum(axis=(2, 3))
    assert iou.min() > 0.75  # shadows are dark, too
    later = world.observe()
    assert (len(later.cameras), later.masks) == (4, None)


def test_masks_of_the_world_come_first(table):
    seen = OutlinedWorld(table, {}).observe(masks=True)
    np.testing.assert_array_equal(seen.masks, table.observe(masks=True).masks)


@pytest.mark.parametrize(
    ("boxes", "error", "words"),
    [
        ({}, InvalidInput, "around each object in at least one camera"),
        ({"0": {NAMES[0]: (10.0, 10.0, 90.0, 90.0)}}, InvalidInput, "around each object"),
        ({"above": {}}, UnknownName, "no camera named 'above'"),
        ({"0": {"025_mug": (10.0, 10.0, 90.0, 90.0)}}, UnknownName, "no object on the table named '025_mug'"),
    ],
)
def test_boxes_that_do_not_do_are_told(table, boxes, error, words):
    with pytest.raises(error, match=words):
        OutlinedWorld(Bare(table), boxes).observe(masks=True)
