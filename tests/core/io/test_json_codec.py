from dataclasses import dataclass

import pytest
from hypothesis import given
from hypothesis import strategies as st

from osfcore.errors import InvalidInput
from osfcore.io.json_codec import Entry, Matrix3, Text, Vector3, decode, encode


class Part(Entry):
    name: Text
    position: Vector3


class Whole(Entry):
    parts: list[Part]
    K: Matrix3 | None = None
    is_new: bool = False


@dataclass(frozen=True, slots=True)
class Score:
    names: tuple[str, ...]
    errors: tuple[tuple[float, ...], ...]
    light: float | None


finite = st.floats(allow_nan=False, allow_infinity=False)


@given(
    names=st.lists(st.text(max_size=4), max_size=3).map(tuple),
    errors=st.lists(st.lists(finite, max_size=3).map(tuple), max_size=3).map(tuple),
    light=st.none() | finite,
)
def test_a_dataclass_survives(names, errors, light):
    score = Score(names, errors, light)
    assert decode(Score, encode(score), "score") == score


def test_members_that_nobody_knows_are_left_alone():
    data = {"parts": [{"name": "a", "position": [1, 2, 3], "colour": "red"}], "more": None}
    assert encode(decode(Whole, data, "whole")) == {"parts": [{"name": "a", "position": [1, 2, 3]}]}


@pytest.mark.parametrize(
    ("data", "words"),
    [
        ([], "whole is [], but it must be a JSON object."),
        ({}, "'parts' of whole is missing, but it must be given."),
        ({"parts": {}}, "parts is {}, but it must be a list."),
        ({"parts": [3]}, "parts[0] is 3, but it must be a JSON object."),
        ({"parts": [{"name": "a"}]}, "'position' of part a is missing, but it must be given."),
        ({"parts": [{"name": "a", "position": [1, True, 3]}]},
         "position of part a is [1, True, 3], but it must be 3 finite numbers."),
        ({"parts": [{"position": [1, 2, 3]}]}, "'name' of parts[0] is missing, but it must be given."),
        ({"parts": [{"name": "\ud800", "position": [1, 2, 3]}]},
         r"name of part \ud800 is '\ud800', but it must be a text without halves of characters."),
        ({"parts": [], "K": [[1, 2, 3]]}, "K is [[1, 2, 3]], but it must be 3 x 3 finite numbers."),
        ({"parts": [], "is_new": 1}, "is_new is 1, but it must be true or false."),
    ],
)  # fmt: skip
def test_what_does_not_fit_is_told_in_one_sentence(data, words):
    with pytest.raises(InvalidInput) as caught:
        decode(Whole, data, "whole")
    assert str(caught.value) == words
