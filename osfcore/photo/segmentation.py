"""Which pixels show an object, from a box around it, clicks and brush strokes: GrabCut (Rother et al. 2004)."""

from __future__ import annotations

import itertools
from collections.abc import Mapping

import cv2
import numpy as np
from jaxtyping import Bool, Float, Float32, UInt8

from osfcore.errors import InvalidInput
from osfcore.photo.photograph import Box, WindowFrame, mask_box

Picture = UInt8[np.ndarray, "h w 3"]
Labels = UInt8[np.ndarray, "h w"]
Mask = Bool[np.ndarray, "h w"]
Points = Float[np.ndarray, "_ 2"]
Pair = tuple[np.ndarray, np.ndarray]  # of what is on the object and of what is not
MIN_BOX_SIDE = 8
_WORKING_SIDE = 200  # of the box at most [px]: fine enough for an outline, and fast
_MARGIN = 0.2  # of the box's sides: what lies so near around it is the sample of the background
_CLICK_RADIUS = 0.06  # of the box's shorter side: what a click speaks for
_NOISE_LEVELS, _NOISE_RADIUS = 20.0, 3.0  # differences and distances that smoothing evens out [levels of 255, px]
_CORE, _SURE_CORE = 0.8, 0.6  # axes, per side of the box, of ellipses in it: probably object, and taken for it
_FORCED = 0.02  # by which the misfit of what begins from the second must be less: it holds what may be no object
_CENTRAL = 0.2  # of the sides: clicks within this distance of the middle do not say that something else is in it
_MOST_MISFIT = 0.3  # above, an outline is doubtful; boxes drawn with usual care have 0.05 to 0.25
_BEHIND, _FRONT = 0.04, 0.1  # misfit gained without what two outlines share: at most, if it is the other's; at least
_DRAWN_OFF = 0.07  # of an object's size: how far its drawn outline may be off
_ITERATIONS = 3
_OUTLINE_PX = 0.7  # by which an outline as polygons may differ from the mask's
_OUTLINE_SIGMA = 0.7  # over which the outline is smoothed [px of the reduced picture]
_WHAT = "box of the object [px]"


def propose_mask(
    image: Picture,
    box: Box,
    foreground: Points,
    background: Points | None = None,
    add: Mask | None = None,
    remove: Mask | None = None,
) -> Mask:
    """Find the mask of an object that a person points at.

    GrabCut runs three times: from the whole box, from an ellipse in it that is probably the object, and, unless a
    click lies elsewhere, from a smaller one that surely is. The result whose extent fits the box best is taken. Of
    each those parts remain that hold a click or a stroke (without such, the largest), and holes are filled unless they
    are marked. The same input always gives the same mask.

    Args:
        image: encoded RGB, as people see it.
        box: x0, y0, x1, y1 around the object, loosely [px]; what lies outside is taken for background.
        foreground: clicks on the object, (x, y) [px]; may be none.
        background: clicks beside it.
        add: strokes of a brush over the object, even outside the box.
        remove: strokes over what is no part of it; they win over other marks.

    Raises:
        InvalidInput: if the box is beside the image or too small, a click on the object is outside the box, strokes
            have another size than the image, or nothing is found.
    """
    shape = image.shape[:2]
    box = _checked_box(box, *shape)
    clicks = _checked_clicks(foreground, box), np.zeros((0, 2)) if background is None else background
    strokes = _checked_stroke(add, shape), _checked_stroke(remove, shape)
    window = _window(box, *shape)
    picture = cv2.bilateralFilter(window.cut(image), -1, _NOISE_LEVELS, _NOISE_RADIUS)
    corners = np.round(window.points(np.reshape(box, (2, 2)))).astype(int)
    marks = _marks(window, corners, clicks, strokes)
    *free, forced = (_tidied(_cut(picture, start), marks) for start in _starts(marks, corners))
    best = min(free, key=lambda mask: _misfit(mask, corners))
    if _are_central(foreground, box) and _misfit(forced, corners) < _misfit(best, corners) - _FORCED:
        best = forced
    mask = window.placed(_smooth(best), shape)
    if not mask.any():
        raise InvalidInput(_WHAT, _corners_text(box), "around something that differs from what surrounds it")
    return mask


def mask_near(image: Picture, outline: Mask) -> Mask:
    """Find the mask of an object from where it is drawn, about right to 7 % of its size: GrabCut near that outline.

    Args:
        image: encoded RGB, as people see it.
        outline: pixels at which the object is drawn; returned as it is where nothing is found.
    """
    left, top, right, bottom = mask_box(outline)
    window = _window((left, top, right, bottom), *outline.shape)
    drawn = (window.cut(outline.astype(np.float32)) > 0.5).astype(np.uint8)
    reach = max(2, int(_DRAWN_OFF * max(np.ptp(window.points(mask_box(outline).reshape(2, 2)), axis=0))))
    around = cv2.getStructuringElement(cv2.MORPH_ELLIPSE, (2 * reach + 1, 2 * reach + 1))
    labels = np.full(drawn.shape, cv2.GC_BGD, np.uint8)
    labels[cv2.dilate(drawn, around) > 0] = cv2.GC_PR_BGD
    labels[drawn > 0] = cv2.GC_PR_FGD
    labels[cv2.erode(drawn, around) > 0] = cv2.GC_FGD
    found = _tidied(
        _cut(cv2.bilateralFilter(window.cut(image), -1, _NOISE_LEVELS, _NOISE_RADIUS), labels.copy()), labels
    )
    mask = window.placed(_smooth(found), outline.shape)
    return mask if mask.any() else outline


def propose_masks(image: Picture, boxes: Mapping[str, Box], clicks: Mapping[str, Points]) -> dict[str, Mask]:
    """Find the masks of several objects: clicks on one are background for the others.

    What two outlines both hold is that object's whose extent fits its box clearly worse without it, if the other's
    does not: what lies in front of another object is seen whole.

    Args:
        image: encoded RGB, as people see it.
        boxes: around each object, by its name [px].
        clicks: on each object.

    Raises:
        InvalidInput: as `propose_mask`.
    """
    masks = {}
    for name, box in boxes.items():
        others = np.concatenate([np.zeros((0, 2)), *(points for other, points in clicks.items() if other != name)])
        masks[name] = propose_mask(image, box, clicks[name], others)
    inside = {name: _checked_box(box, *image.shape[:2]) for name, box in boxes.items()}
    for pair in itertools.combinations(masks, 2):
        both = np.logical_and(*(masks[name] for name in pair))
        if both.any():
            lacks = {n: _misfit(masks[n] & ~both, inside[n]) - _misfit(masks[n], inside[n]) for n in pair}
            behind, front = sorted(pair, key=lacks.__getitem__)
            if lacks[behind] < _BEHIND and lacks[front] > _FRONT:
                masks[behind] = masks[behind] & ~both
    return masks


def outline_doubt(name: str, box: Box, mask: Mask) -> str:
    """Return a sentence if an outline does not fill the box that it comes from; "" if it does.

    Args:
        name: of the object, for people.
        box: that was drawn around it [px].
        mask: that was found of it.
    """
    inside = _checked_box(box, *mask.shape)
    if _misfit(mask, inside) <= _MOST_MISFIT:
        return ""
    spans = np.ptp(mask_box(mask).reshape(2, 2), axis=0) / np.ptp(np.reshape(inside, (2, 2)), axis=0)
    across, down = np.round(100 * spans).astype(int).tolist()
    found = f"The outline of {name} spans {across} % of its box's width and {down} % of its height"
    return f"{found}: draw the box closely around all of the object, or correct the outline."


def outline_of(mask: Mask) -> tuple[tuple[tuple[float, float], ...], ...]:
    """Return closed polygons around a mask and around the holes in it [px], right to 0.7 px."""
    lines, _ = cv2.findContours(mask.astype(np.uint8), cv2.RETR_CCOMP, cv2.CHAIN_APPROX_NONE)
    plain = [cv2.approxPolyDP(line, _OUTLINE_PX, True)[:, 0] + 0.5 for line in lines]
    return tuple(tuple((float(x), float(y)) for x, y in line) for line in plain if len(line) > 2)


def _window(box: Box, height: int, width: int) -> WindowFrame:
    """Return a box with some margin, within the picture, and reduced."""
    x0, y0, x1, y1 = box
    across, down = _MARGIN * (x1 - x0), _MARGIN * (y1 - y0)
    left, top = max(0, int(x0 - across)), max(0, int(y0 - down))
    right, bottom = min(width, int(np.ceil(x1 + across))), min(height, int(np.ceil(y1 + down)))
    scale = min(1.0, _WORKING_SIDE / max(x1 - x0, y1 - y0))
    size = max(round(scale * (right - left)), 1), max(round(scale * (bottom - top)), 1)
    return WindowFrame(left, top, right, bottom, *size)


def _checked_box(box: Box, height: int, width: int) -> Box:
    x0, y0, x1, y1 = (float(side) for side in box)
    inside = max(x0, 0.0), max(y0, 0.0), min(x1, float(width)), min(y1, float(height))
    sides = inside[2] - inside[0], inside[3] - inside[1]
    if not np.all(np.isfinite(box)) or not min(sides) > 0:
        allowed = f"within the picture's {width} x {height}, given as left, top, right, bottom"
        raise InvalidInput(_WHAT, _corners_text(box), allowed)
    if min(sides) < MIN_BOX_SIDE:
        raise InvalidInput(_WHAT, _corners_text(box), f"at least {MIN_BOX_SIDE} a side within the picture")
    return inside


def _checked_clicks(points: np.ndarray, box: Box) -> Points:
    low, high = np.reshape(box, (2, 2))
    inside = np.all((points >= low) & (points < high), axis=1)  # false for NaN
    if not inside.all():
        allowed = f"inside its box, {_corners_text(box)}"
        raise InvalidInput("click on the object [px]", points[~inside][0].tolist(), allowed)
    return points


def _checked_stroke(stroke: np.ndarray | None, shape: tuple[int, int]) -> np.ndarray:
    if stroke is not None and stroke.shape != shape:
        raise InvalidInput("size of the brush strokes' picture [px]", stroke.shape, f"{shape}, as the photo's")
    return np.zeros(shape, np.float32) if stroke is None else stroke.astype(np.float32)


def _corners_text(box: Box) -> str:
    return ", ".join(f"{side:.0f}" for side in box)


def _marks(window: WindowFrame, corners: np.ndarray, clicks: Pair, strokes: Pair) -> Labels:
    """Label each pixel: GC_FGD or GC_BGD where marks say so, GC_PR_FGD where it is to be found out."""
    marks = np.full((window.height, window.width), cv2.GC_BGD, np.uint8)
    (x0, y0), (x1, y1) = corners
    marks[y0:y1, x0:x1] = cv2.GC_PR_FGD
    radius = max(round(_CLICK_RADIUS * min(x1 - x0, y1 - y0)), 1)
    on_object = np.zeros_like(marks)
    for point in window.points(clicks[0]):
        cv2.circle(on_object, np.floor(point).astype(int).tolist(), radius, 1, -1)
    for point in window.points(clicks[1]):
        cv2.circle(marks, np.floor(point).astype(int).tolist(), radius, cv2.GC_BGD, -1)
    marks[y0:y1, x0:x1][on_object[y0:y1, x0:x1] > 0] = cv2.GC_FGD
    some = 0.3  # of a pixel's area is enough for a stroke that is thin
    marks[window.cut(strokes[0]) > some] = cv2.GC_FGD
    marks[window.cut(strokes[1]) > some] = cv2.GC_BGD
    return marks


def _starts(marks: Labels, corners: np.ndarray) -> list[Labels]:
    """Return three starts of GrabCut: all unknown is probably object, only an ellipse is, a smaller one surely is."""
    unknown = marks == cv2.GC_PR_FGD
    outer = np.where(unknown & ~_ellipse(marks.shape, corners, _CORE), cv2.GC_PR_BGD, marks)
    sure = np.where(unknown & _ellipse(marks.shape, corners, _SURE_CORE), cv2.GC_FGD, marks)
    return [marks.copy(), outer.astype(np.uint8), sure.astype(np.uint8)]


def _ellipse(shape: tuple[int, ...], corners: np.ndarray, share: float) -> Mask:
    """Return the ellipse in the middle of a box whose axes are that share of its sides."""
    core = np.zeros(shape, np.uint8)
    sides = share * (corners[1] - corners[0])
    cv2.ellipse(core, (corners.mean(axis=0).tolist(), sides.tolist(), 0.0), 1, -1)
    return core > 0


def _are_central(clicks: Points, box: Box) -> bool:
    low, high = np.reshape(box, (2, 2))
    return bool(np.all(np.linalg.norm((clicks - low) / (high - low) - 0.5, axis=1) < _CENTRAL))


def _smooth(mask: Mask) -> Float32[np.ndarray, "h w"]:
    return cv2.GaussianBlur(mask.astype(np.float32), (0, 0), _OUTLINE_SIGMA, borderType=cv2.BORDER_REPLICATE)


def _cut(picture: Picture, labels: Labels) -> Mask:
    is_object = labels % 2 == 1  # GC_FGD and GC_PR_FGD are odd
    if is_object.all() or not is_object.any():  # GrabCut needs samples of both
        return np.zeros(labels.shape, bool)
    cv2.setRNGSeed(0)  # of this thread alone; GrabCut clusters colours from a random start
    models = np.zeros((1, 65)), np.zeros((1, 65))
    no_box = (0, 0, 0, 0)  # the labels say more
    cv2.grabCut(picture, labels, no_box, *models, _ITERATIONS, cv2.GC_INIT_WITH_MASK)
    return labels % 2 == 1


def _tidied(found: Mask, marks: Labels) -> Mask:
    """Keep the parts that hold a mark, else the largest; fill holes that hold no mark of the background."""
    if not found.any():
        return found
    _, parts, stats, _ = cv2.connectedComponentsWithStats(found.astype(np.uint8), connectivity=4)
    marked = np.unique(parts[found & (marks == cv2.GC_FGD)])
    largest = 1 + np.argmax(stats[1:, cv2.CC_STAT_AREA])
    kept = np.isin(parts, marked if marked.size else largest)
    _, gaps = cv2.connectedComponents(np.pad(~kept, 1, constant_values=True).astype(np.uint8), connectivity=4)
    background = np.pad(marks == cv2.GC_BGD, 1, constant_values=True)
    holes = (gaps > 0) & ~np.isin(gaps, gaps[background])
    return kept | holes[1:-1, 1:-1]


def _misfit(mask: Mask, box: np.ndarray | Box) -> float:
    """Return how far a mask's extent is from a box, summed over its four sides, each per side of the box."""
    if not mask.any():
        return np.inf
    corners = np.reshape(box, (2, 2))
    return float((np.abs(mask_box(mask).reshape(2, 2) - corners) / (corners[1] - corners[0])).sum())
