import pytest

from osfcore.errors import InvalidInput
from osfcore.io.json_codec import Entry, Matrix3, Text, Vector3, decode, encode


class Part(Entry):
    name: Text
    position: Vector3


class Whole(Entry):
    parts: list[Part]
    K: Matrix3 | None = None
    is_new: bool = False


def test_members_that_nobody_knows_are_left_alone():
    data = {"parts": [{"name": "a", "position": [1, 2, 3], "colour": "red"}], "more": None}
    assert encode(decode(Whole, data, "whole")) == {"parts": [{"name": "a", "position": [1, 2, 3]}]}


@pytest.mark.parametrize(
    ("data", "what"),
    [
        ([], "whole"),
        ({}, "'parts' of whole"),
        ({"parts": {}}, "parts"),
        ({"parts": [3]}, "parts[0]"),
        ({"parts": [{"name": "a"}]}, "'position' of part a"),
        ({"parts": [{"name": "a", "position": [1, True, 3]}]}, "position of part a"),
        ({"parts": [{"position": [1, 2, 3]}]}, "'name' of parts[0]"),
        ({"parts": [{"name": "\ud800", "position": [1, 2, 3]}]}, r"name of part \ud800"),
        ({"parts": [], "K": [[1, 2, 3]]}, "K"),
        ({"parts": [], "is_new": 1}, "is_new"),
    ],
)
def test_what_does_not_fit_is_refused_with_its_place(data, what):
    with pytest.raises(InvalidInput) as caught:
        decode(Whole, data, "whole")
    assert caught.value.what == what
