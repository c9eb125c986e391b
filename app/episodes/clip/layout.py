"""How a clip looks: title, view, the two pictures, the falling curve, and the closing card."""

from __future__ import annotations

from functools import cache

import cv2
import numpy as np
from jaxtyping import Float, UInt8
from PIL import Image, ImageDraw, ImageFont

WIDTH, HEIGHT = 1920, 1080
VIEW = (40, 128, 1396, 700)  # left, top, width, height [px]
SIDE = 412  # of the two pictures
_GOAL, _NOW = (1468, 160), (1468, 628)
_CURVE = (40, 852, 1396, 188)
_PLOT = (180, 884, 1080, 122)  # within it
_GROUND, _PANEL, _TEXT, _MUTED, _ACCENT, _WARM = (
    (19, 21, 23),
    (27, 30, 33),
    (233, 231, 226),
    (155, 162, 169),
    (99, 184, 194),
    (240, 172, 48),
)
TITLE = "Show a photo, and the table becomes it"
SUBTITLE = "Object-centric neural scattering functions: poses and light from images alone"


class Layout:
    """Frames of one clip.

    Args:
        goal: how the table should look.
        far_m: distance of the farthest object from its goal after each action [m].
    """

    def __init__(self, goal: UInt8[np.ndarray, "h w 3"], far_m: Float[np.ndarray, "A"]) -> None:
        self._far_m = far_m
        self._still = self._background(goal)

    def frame(
        self, view: UInt8[np.ndarray, "h w 3"], now: UInt8[np.ndarray, "s s 3"], stage: str, action: float
    ) -> UInt8[np.ndarray, "1080 1920 3"]:
        """One frame.

        Args:
            view: the 3D view.
            now: the table as the goal's camera sees it.
            stage: what is being done.
            action: how many have been executed; between two whole numbers one is under way.
        """
        frame = self._still.copy()
        _put(frame, view, VIEW[:2])
        _put(frame, _sized(now), _NOW)
        self._draw_curve(frame, action)
        picture = Image.fromarray(frame)
        draw = ImageDraw.Draw(picture)
        left, top, _, height = VIEW
        box = draw.textbbox((left + 28, top + height - 52), stage, _font(28))
        draw.rounded_rectangle((box[0] - 16, box[1] - 12, box[2] + 16, box[3] + 12), 12, fill=(0, 0, 0))
        draw.text((left + 28, top + height - 52), stage, _TEXT, _font(28))
        far = np.interp(action, np.arange(len(self._far_m)), self._far_m)
        draw.text((1405, 930), length_text(far), _TEXT, _font(52), anchor="rm")
        draw.text((1405, 982), "to go", _MUTED, _font(24), anchor="rm")
        return np.asarray(picture)

    def _background(self, goal: np.ndarray) -> UInt8[np.ndarray, "1080 1920 3"]:
        picture = Image.new("RGB", (WIDTH, HEIGHT), _GROUND)
        draw = ImageDraw.Draw(picture)
        draw.text((40, 76), TITLE, _TEXT, _font(46), anchor="lm")
        draw.text((1880, 79), SUBTITLE, _MUTED, _font(24), anchor="rm")
        for (x, y), caption in ((_GOAL, "The photo"), (_NOW, "The table, from the same place")):
            draw.text((x, y - 10), caption, _MUTED, _font(24), anchor="ls")
        left, top, width, height = _CURVE
        draw.rounded_rectangle((left, top, left + width, top + height), 12, fill=_PANEL)
        draw.text((left + 24, 912), "Farthest", _MUTED, _font(24), anchor="lm")
        draw.text((left + 24, 944), "object", _MUTED, _font(24), anchor="lm")
        x, y, w, h = _PLOT
        draw.line((x, y + h, x + w, y + h), fill=(60, 66, 72), width=2)
        draw.text((x, y + h + 18), "0", _MUTED, _font(18), anchor="mm")
        draw.text((x + w, y + h + 18), f"{len(self._far_m) - 1} pushes", _MUTED, _font(18), anchor="mm")
        frame = np.asarray(picture).copy()
        _put(frame, _sized(goal), _GOAL)
        return frame

    def _draw_curve(self, frame: np.ndarray, action: float) -> None:
        x, y, w, h = _PLOT
        last, top = max(len(self._far_m) - 1, 1), max(self._far_m.max(), 1e-3)
        at = np.append(np.arange(np.floor(action) + 1), action)
        values = np.interp(at, np.arange(len(self._far_m)), self._far_m)
        points = np.column_stack([x + w * at / last, y + h * (1 - values / top)])
        sixteenths = np.round(points * 16).astype(np.int32)
        area = np.concatenate([points, [[points[-1, 0], y + h], [x, y + h]]]).round().astype(np.int32)
        filled = frame.copy()
        cv2.fillPoly(filled, [area], _ACCENT, cv2.LINE_AA)
        cv2.addWeighted(filled, 0.18, frame, 0.82, 0, dst=frame)
        cv2.polylines(frame, [sixteenths], False, _ACCENT, 4, cv2.LINE_AA, shift=4)
        cv2.circle(frame, tuple(points[-1].round().astype(int)), 8, _TEXT, -1, cv2.LINE_AA)


def closing_card(
    last: UInt8[np.ndarray, "1080 1920 3"], headline: str, details: str, verdict: str, *, is_reached: bool
) -> UInt8[np.ndarray, "1080 1920 3"]:
    """The last frame, dark, with what it came to.

    Args:
        last: frame of the clip.
        headline: such as "9.3 cm to 2 mm".
        details: such as "18 pushes, 95 s".
        verdict: how it ended, a sentence.
        is_reached: whether that is good news.
    """
    dimmed = cv2.GaussianBlur(last, (0, 0), 9)
    picture = Image.fromarray((dimmed * 0.28).astype(np.uint8))
    draw = ImageDraw.Draw(picture)
    middle = WIDTH // 2
    draw.text((middle, 430), headline, _TEXT, _font(130), anchor="mm")
    draw.text((middle, 560), details, _TEXT, _font(46), anchor="mm")
    draw.text((middle, 650), verdict, _ACCENT if is_reached else _WARM, _font(38), anchor="mm")
    draw.text((middle, 1000), SUBTITLE, _MUTED, _font(26), anchor="mm")
    return np.asarray(picture)


def length_text(metres: float) -> str:
    """A distance for people."""
    return f"{1000 * metres:.1f} mm" if metres < 0.01 else f"{100 * metres:.1f} cm"


def _put(frame: np.ndarray, part: np.ndarray, corner: tuple[int, int]) -> None:
    x, y = corner
    frame[y : y + part.shape[0], x : x + part.shape[1]] = part


def _sized(picture: np.ndarray) -> UInt8[np.ndarray, "s s 3"]:
    """A picture as a square; what is not square keeps its proportions on the panel's colour."""
    height, width = picture.shape[:2]
    scale = SIDE / max(height, width)
    size = max(round(width * scale), 1), max(round(height * scale), 1)
    fitted = cv2.resize(picture, size, interpolation=cv2.INTER_AREA if scale < 1 else cv2.INTER_CUBIC)
    square = np.full((SIDE, SIDE, 3), _PANEL, np.uint8)
    _put(square, fitted, ((SIDE - size[0]) // 2, (SIDE - size[1]) // 2))
    return square


@cache
def _font(size: int) -> ImageFont.FreeTypeFont | ImageFont.ImageFont:
    return ImageFont.load_default(size)
