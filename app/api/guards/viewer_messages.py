"""Which messages a browser may send to the 3D view: what its own page sends, and no more.

viser takes any message from any client: one could disable buttons for all visitors, or upload files to a button. So
the relay reads each frame (msgpack: a map with "type") and passes on the few kinds that this viewer answers to.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Set
from typing import Any

import msgspec

MAX_FRAME_BYTES = 1 << 14
RATE, BURST = 200.0, 600.0  # messages a second; a camera that is dragged sends one a frame
_MOST_TEXT = 200
CAMERA, DROP = "ViewerCameraMessage", "TransformControlsDragEndMessage"
_FIELDS: Mapping[str, Set[str]] = {
    CAMERA: {
        "type", "wxyz", "position", "fov", "near", "far", "image_height", "image_width", "look_at", "up_direction",
    },
    "TransformControlsUpdateMessage": {"type", "name", "wxyz", "position", "owner"},
    "TransformControlsDragStartMessage": {"type", "name", "owner"},
    DROP: {"type", "name", "owner"},
    "SceneNodeDragMessage": {
        "type", "phase", "name", "instance_index", "start_position", "start_screen_pos", "end_position",
        "end_screen_pos", "button", "modifier", "owner",
    },
}  # fmt: skip


def allowed_kind(frame: bytes) -> str | None:
    """The kind of message in a frame, if the page sends such with such fields; None if it may not pass."""
    if len(frame) > MAX_FRAME_BYTES:
        return None
    try:
        message = msgspec.msgpack.decode(frame, type=dict[str, Any])
    except (msgspec.DecodeError, UnicodeDecodeError, RecursionError):
        return None
    kind = message.get("type")
    if not isinstance(kind, str) or kind not in _FIELDS or not message.keys() <= _FIELDS[kind]:
        return None
    return kind if all(_is_plain(value) for value in message.values()) else None


def _is_plain(value: object) -> bool:
    """A number, a short text, a few numbers or nothing."""
    if value is None:
        return True
    if isinstance(value, list):
        return len(value) <= 4 and all(_is_number(number) for number in value)
    return _is_number(value) or (isinstance(value, str) and len(value) <= _MOST_TEXT)


def _is_number(value: object) -> bool:
    return isinstance(value, bool | int) or (isinstance(value, float) and math.isfinite(value))
