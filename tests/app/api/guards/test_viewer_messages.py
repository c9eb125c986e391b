import msgspec
import pytest
from hypothesis import example, given
from hypothesis import strategies as st

from app.api.guards.token_gate import RateLimit
from app.api.guards.viewer_messages import MAX_FRAME_BYTES, allowed_kind
from tests.app.viewer.conftest import CAMERA

HANDLE = {"type": "TransformControlsUpdateMessage", "name": "/a", "wxyz": [1.0, 0, 0, 0], "position": [0.0, 0, 1]}


def encoded(message):
    return msgspec.msgpack.encode(message)


@pytest.mark.parametrize(
    "message", [CAMERA, HANDLE, {"type": "TransformControlsDragEndMessage", "name": "/a", "owner": ""}]
)
def test_what_the_page_sends_is_allowed(message):
    assert allowed_kind(encoded(message)) == message["type"]


@pytest.mark.parametrize(
    "message",
    [
        {"type": "GuiUpdateMessage", "uuid": "a", "updates": {"value": True}},
        HANDLE | {"position": ["x"] * 3},
        HANDLE | {"position": [0.0] * 100},
        HANDLE | {"position": [float("inf"), 0, 0]},
        HANDLE | {"scale": 3},
        HANDLE | {"name": "x" * 1000},
        {"type": "FileTransferStartUpload", "source_component_uuid": "a", "transfer_uuid": "b", "size_bytes": 1},
        {"type": "RunJavascriptMessage", "source": "alert(1)"},
        {"type": "ShareUrlRequest"},
        {"type": ["ViewerCameraMessage"]},
        {},
        [],
        "text",
    ],
)
def test_everything_else_is_not(message):
    assert allowed_kind(encoded(message)) is None


def test_large_frames_are_not():
    padded = encoded(CAMERA) + b"\0" * MAX_FRAME_BYTES
    assert allowed_kind(padded) is None


@given(frame=st.binary(max_size=200))
@example(frame=b"\x81\xa1\xff\xc0")  # a name that is no UTF-8
def test_noise_is_not(frame):
    assert allowed_kind(frame) is None


def test_tokens_come_back_with_time_up_to_the_burst():
    now = 0.0
    limit = RateLimit(2.0, 3.0, clock=lambda: now)
    assert [limit.take() for _ in range(4)] == [True, True, True, False]
    now = 1.0
    assert [limit.take() for _ in range(3)] == [True, True, False]
    now = 100.0
    assert [limit.take() for _ in range(4)] == [True, True, True, False]
    assert limit.is_empty
