import cv2
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from osfcore.errors import InvalidInput
from osfcore.photo.segmentation import mask_near, outline_doubt, propose_mask, propose_masks
from tests.support.errors import about

WIDTH, HEIGHT = 200, 160
NO_CLICK = np.empty((0, 2))


def textured(rng, colour, contrast=25.0):
    """A surface with soft blotches, as wood or print has."""
    noise = cv2.GaussianBlur(rng.standard_normal((HEIGHT, WIDTH, 3)), (0, 0), 3)
    return np.asarray(colour, float) + contrast * noise / noise.std()


def drawn(table, *layers, rng, noise=6.0):
    """Surfaces within masks over a table, with the noise of a sensor."""
    picture = table.copy()
    for surface, mask in layers:
        picture[mask] = surface[mask]
    return np.clip(picture + noise * rng.standard_normal(picture.shape), 0, 255).astype(np.uint8)


def disc(centre, radius):
    y, x = np.mgrid[:HEIGHT, :WIDTH] + 0.5
    return np.hypot(x - centre[0], y - centre[1]) < radius


def box_around(mask, grown=0.05):
    ys, xs = np.nonzero(mask)
    across, down = grown * np.ptp(xs), grown * np.ptp(ys)
    return xs.min() - across, ys.min() - down, xs.max() + 1 + across, ys.max() + 1 + down


def overlap(a, b):
    return (a & b).sum() / (a | b).sum()


def random_scene(seed):
    """A box or a ball on a table whose colour is 80 levels away; each varies by 30 levels, the sensor by 15."""
    rng = np.random.default_rng(seed)
    table, away = rng.uniform(60, 195, 3), rng.standard_normal(3)
    colour = table + 80 * away / np.linalg.norm(away)
    centre = (rng.uniform(80, 120), rng.uniform(65, 95))
    sides = (rng.uniform(50, 90), rng.uniform(40, 80))
    if rng.random() < 0.6:
        corners = cv2.boxPoints((centre, sides, rng.uniform(0, 90))).round().astype(np.int32)
        shape = cv2.fillConvexPoly(np.zeros((HEIGHT, WIDTH), np.uint8), corners, 1) > 0
    else:
        shape = disc(centre, rng.uniform(25, 50))
    layers = (textured(rng, colour, 30.0), shape)
    return drawn(textured(rng, table, 30.0), layers, rng=rng, noise=15.0), shape, centre


@settings(max_examples=8)
@given(seed=st.integers(0, 10_000), grown=st.floats(0.02, 0.1), other_seed=st.integers(0, 10))
def test_an_object_on_a_table_is_found_by_a_mask_that_depends_on_its_input_alone(seed, grown, other_seed):
    image, shape, centre = random_scene(seed)
    found = propose_mask(image, box_around(shape, grown), np.array([centre]))
    assert overlap(found, shape) > 0.9
    cv2.setRNGSeed(other_seed)
    np.testing.assert_array_equal(propose_mask(image, box_around(shape, grown), np.array([centre])), found)


@pytest.mark.parametrize("shift_px", [0, 3, -4])
def test_where_an_object_is_drawn_about_right_its_mask_is_found(shift_px):
    image, shape, _ = random_scene(3)
    found = mask_near(image, np.roll(shape, shift_px, axis=1))
    assert overlap(found, shape) > 0.93
    assert overlap(np.roll(shape, 8, axis=1), shape) < 0.93


def test_a_large_photo_is_no_different():
    """It is looked at with fewer pixels; the outline is as good as these, and smooth."""
    image, shape, centre = random_scene(1)
    large, true = (np.kron(a, np.ones((6, 6, 1)[: a.ndim], a.dtype)) for a in (image, shape))
    found = propose_mask(large, box_around(true), 6 * np.array([centre]))
    assert overlap(found, true) > 0.95
    contours, _ = cv2.findContours(found.astype(np.uint8), cv2.RETR_EXTERNAL, cv2.CHAIN_APPROX_NONE)
    assert len(contours) == 1
    assert cv2.arcLength(contours[0], True) < 1.15 * cv2.arcLength(cv2.convexHull(contours[0]), True)


def test_the_click_says_which_of_two_objects_is_meant():
    rng = np.random.default_rng(3)
    left, right = disc((65, 80), 26), disc((135, 80), 26)
    surface = textured(rng, (190, 60, 50))
    image = drawn(textured(rng, (120, 130, 120)), (surface, left), (surface, right), rng=rng)
    box, clicks = box_around(left | right), {"left": np.array([[65.0, 80.0]]), "right": np.array([[135.0, 80.0]])}
    masks = propose_masks(image, dict.fromkeys(clicks, box), clicks)
    for name, meant in (("left", left), ("right", right)):
        assert overlap(propose_mask(image, box, clicks[name]), meant) > 0.9
        assert overlap(masks[name], meant) > 0.9
    assert overlap(propose_mask(image, box, np.concatenate(list(clicks.values()))), left | right) > 0.9


def test_a_click_beside_the_object_and_strokes_over_it_count():
    image, shape, centre = random_scene(6)
    box = box_around(shape)
    assert overlap(propose_mask(image, box, NO_CLICK), shape) > 0.9  # the largest part
    wrong = propose_mask(image, box, NO_CLICK, background=np.array([centre]))
    assert not wrong[int(centre[1]), int(centre[0])]
    beside = disc((box[0] + 4, box[1] + 4), 4)
    added = propose_mask(image, box, np.array([centre]), add=beside)
    assert (added & beside).sum() > 0.7 * beside.sum()
    assert overlap(added & ~beside, shape & ~beside) > 0.85


def test_holes_are_filled_unless_they_are_marked():
    rng = np.random.default_rng(8)
    ring, hole = disc((100, 80), 50), disc((100, 80), 20)
    image = drawn(textured(rng, (200, 200, 190), 10.0), (textured(rng, (150, 40, 40), 10.0), ring & ~hole), rng=rng)
    click = np.array([[65.0, 80.0]])
    assert overlap(propose_mask(image, box_around(ring), click), ring) > 0.95
    marked = propose_mask(image, box_around(ring), click, background=np.array([[100.0, 80.0]]))
    assert overlap(marked, ring & ~hole) > 0.95


def test_an_object_may_fill_the_picture_or_lead_out_of_it():
    image, shape, _ = random_scene(9)
    ys, xs = np.nonzero(shape)
    cut = slice(ys.min() + 10, None), slice(xs.min() + 10, None)
    part, true = np.ascontiguousarray(image[cut]), shape[cut]
    click = np.argwhere(true).mean(axis=0)[::-1][None] + 0.5
    assert overlap(propose_mask(part, (-20, -20, *box_around(true)[2:]), click), true) > 0.9
    inside = np.ascontiguousarray(image[ys.min() : ys.max(), xs.min() : xs.max()])
    assert propose_mask(inside, (0, 0, *inside.shape[1::-1]), click).any()


@pytest.mark.parametrize(
    ("box", "click", "what"),
    [
        ((300, 20, 400, 90), (350, 50), "box"),
        ((90, 20, 40, 90), (60, 50), "box"),
        ((np.nan, 20, 40, 90), (30, 50), "box"),
        ((20, 20, 27, 90), (23, 50), "box"),
        ((195, 20, 300, 90), (197, 50), "box"),
        ((40, 20, 90, 90), (95, 50), "click"),
        ((40, 20, 90, 90), (np.nan, 50), "click"),
    ],
)
def test_boxes_and_clicks_that_make_no_sense_are_refused(box, click, what):
    image, _, _ = random_scene(0)
    with pytest.raises(InvalidInput, check=about(what)):
        propose_mask(image, box, np.array([click], float))


@pytest.mark.wrong_arrays
def test_strokes_of_another_size_or_over_all_of_the_picture_are_refused():
    image, _, _ = random_scene(0)
    with pytest.raises(InvalidInput, check=about("brush strokes")):
        propose_mask(image, (40, 20, 90, 90), NO_CLICK, add=np.ones((5, 5), bool))
    with pytest.raises(InvalidInput, check=about("box")):
        propose_mask(image, (40, 20, 90, 90), NO_CLICK, remove=np.ones((HEIGHT, WIDTH), bool))


def rectangle(left, top, right, bottom):
    mask = np.zeros((HEIGHT, WIDTH), bool)
    mask[top:bottom, left:right] = True
    return mask


def test_a_pale_can_on_a_pale_table_is_more_than_its_label():
    rng, can = np.random.default_rng(0), rectangle(70, 30, 130, 130)
    table, body, label = (textured(rng, colour, 20.0) for colour in ((150,) * 3, (165,) * 3, (60, 60, 160)))
    image = drawn(table, (body, can), (label, rectangle(74, 45, 126, 85)), rng=rng)
    assert overlap(propose_mask(image, box_around(can), np.array([[100.0, 80.0]])), can) > 0.7


def test_what_two_outlines_hold_belongs_to_the_object_in_front():
    """Its box is filled only together with it."""
    rng = np.random.default_rng(0)
    table, red, blue, white = (
        textured(rng, colour, 12.0) for colour in ((170, 165, 160), (170, 50, 50), (60, 80, 170), (240,) * 3)
    )
    back, can, lid = rectangle(50, 20, 150, 110), rectangle(90, 50, 140, 140), rectangle(90, 50, 140, 90)
    image = drawn(table, (red, back), (blue, can), (white, lid), rng=rng)
    boxes = {"back": box_around(back), "can": box_around(can)}
    masks = propose_masks(image, boxes, {"back": np.array([[60.0, 40.0]]), "can": np.array([[115.0, 125.0]])})
    assert overlap(masks["can"], can) > 0.95
    assert overlap(masks["back"], back & ~can) > 0.95


def test_an_outline_that_does_not_fill_its_box_is_doubtful():
    box = (60.0, 20.0, 140.0, 140.0)
    assert not outline_doubt("the can", box, rectangle(62, 24, 137, 136))
    doubt = outline_doubt("the can", box, rectangle(70, 50, 110, 110))
    for fact in ("the can", "50 % of its box's width", "50 % of its height"):
        assert fact in doubt
    cut = (60.0, 80.0, 140.0, 200.0)  # of a box that reaches out of the picture, what is in it counts
    assert not outline_doubt("the can", cut, rectangle(62, 82, 138, HEIGHT))
