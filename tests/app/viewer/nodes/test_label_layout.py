import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from app.viewer.nodes.label_layout import CHARACTER, LINE, separated
from app.viewer.nodes.room import VIEW_AT, VIEW_FOV_RAD, VIEW_FROM
from osfcore.geometry.cameras import Camera

VIEW = Camera.look_at("view", VIEW_FROM, VIEW_AT, fov_y_deg=float(np.rad2deg(VIEW_FOV_RAD)))
on_table = st.tuples(st.floats(-0.3, 0.3), st.floats(-0.3, 0.3), st.floats(0.02, 0.25))


@given(anchors=st.lists(on_table, min_size=1, max_size=5))
def test_no_label_covers_another_and_none_leaves_its_object_sideways(anchors):
    anchors = np.array(anchors)
    texts = [("Mug", "Cracker box", "Potted meat can", "Bowl", "Tuna fish can")[i] for i in range(len(anchors))]
    raised = separated(anchors, texts)
    np.testing.assert_array_equal(raised[:, :2], anchors[:, :2])
    assert np.all(raised[:, 2] >= anchors[:, 2] - 1e-9)
    place = VIEW.project(raised) / VIEW.height
    for i, j in zip(*np.triu_indices(len(texts), 1), strict=True):
        apart = np.abs(place[i] - place[j])
        assert apart[1] > 0.8 * LINE or apart[0] > 0.9 * CHARACTER * (len(texts[i]) + len(texts[j])) / 2


def test_labels_that_are_clear_of_each_other_stay():
    anchors = np.array([[-0.2, 0.0, 0.1], [0.2, 0.0, 0.1], [0.0, 0.25, 0.2]])
    np.testing.assert_allclose(separated(anchors, ["Mug", "Bowl", "Cracker box"]), anchors, atol=1e-12)
    assert separated(np.zeros((0, 3)), []).shape == (0, 3)


def test_the_higher_of_two_is_raised():
    anchors = np.array([[0.0, 0.0, 0.1], [0.01, 0.02, 0.1]])
    raised = separated(anchors, ["Mug", "Bowl"])
    assert raised[0, 2] == pytest.approx(0.1)
    assert raised[1, 2] > 0.11
