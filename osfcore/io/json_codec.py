"""The one JSON codec: kinds of entries as pydantic models, and one sentence for what does not fit them.

The models of `scene_file` and `state_file` are what files hold and what the REST interface sends. Reports and scores
are plain dataclasses, which the same codec takes.
"""

from __future__ import annotations

from collections.abc import Mapping
from functools import cache
from typing import Annotated, Any, TypeVar

from pydantic import (
    AfterValidator,
    BaseModel,
    ConfigDict,
    Field,
    FiniteFloat,
    TypeAdapter,
    ValidationError,
    ValidatorFunctionWrapHandler,
    WrapValidator,
)
from pydantic_core import ErrorDetails, PydanticCustomError

from osfcore.errors import InvalidInput, shown
from osfcore.io.files import is_text

T = TypeVar("T")
_MOST_CHARACTERS = 80  # of a value in a sentence


def _all_of_it(allowed: str) -> WrapValidator:
    """Refuse an array as a whole, not number by number."""

    def validate(value: object, inner: ValidatorFunctionWrapHandler) -> Any:  # noqa: ANN401
        try:
            return inner(value)
        except ValidationError as error:
            raise PydanticCustomError("array", allowed) from error  # pyright: ignore[reportArgumentType]

    return WrapValidator(validate)


def _whole_characters(text: str) -> str:
    if not is_text(text):
        raise PydanticCustomError("text", "a text without halves of characters")
    return text


Text = Annotated[str, AfterValidator(_whole_characters)]
Vector3 = Annotated[list[FiniteFloat], Field(min_length=3, max_length=3), _all_of_it("3 finite numbers")]
Vector4 = Annotated[list[FiniteFloat], Field(min_length=4, max_length=4), _all_of_it("4 finite numbers")]
Matrix3 = Annotated[list[Vector3], Field(min_length=3, max_length=3), _all_of_it("3 x 3 finite numbers")]
Matrix4 = Annotated[list[Vector4], Field(min_length=4, max_length=4), _all_of_it("4 x 4 finite numbers")]


class Entry(BaseModel):
    """A JSON object with typed members; members that it does not know are left alone."""

    model_config = ConfigDict(extra="ignore", strict=True, frozen=True)


@cache
def _adapter(kind: type[T]) -> TypeAdapter[T]:
    return TypeAdapter(kind)


def encode(value: object) -> Any:  # noqa: ANN401
    """An entry or a dataclass as plain lists, numbers and texts, without members that were left out."""
    return _adapter(type(value)).dump_python(value, mode="json", exclude_unset=True)


def decode(kind: type[T], data: object, what: str) -> T:
    """An entry or a dataclass of parsed JSON.

    Args:
        kind: which.
        data: what `json.loads` made of it.
        what: the whole, for the sentence: "scene".

    Raises:
        InvalidInput: for the first thing that does not fit; the message says where it stands.
    """
    try:
        return _adapter(kind).validate_python(data)
    except ValidationError as error:
        raise _refusal(error.errors(include_url=False)[0], data, what) from None


def _refusal(error: ErrorDetails, data: object, what: str) -> InvalidInput:
    key, owner = _place(error["loc"], data, what)
    if error["type"] == "missing":
        return InvalidInput(f"{key!r} of {owner}", "missing", "given")
    place = f"{key} of {owner}" if key and owner != what else key or owner
    return InvalidInput(place, shown(repr(error["input"]), _MOST_CHARACTERS), _allowed(error))


def _place(path: tuple[int | str, ...], data: object, what: str) -> tuple[str, str]:
    """Where an error stands: a member, "position", and whose it is, "object 006_mustard_bottle"."""
    owner, key, value = what, "", data
    for part in path:
        if isinstance(part, int):
            value = value[part] if isinstance(value, list) else None
            name = value.get("name") if isinstance(value, dict) else None
            owner = f"{key.removesuffix('s')} {shown(name)}" if isinstance(name, str) else f"{key}[{part}]"
            key = ""
        else:
            owner, key = key if key and owner == what else owner, part
            value = value.get(part) if isinstance(value, Mapping) else None
    return key, owner


def _allowed(error: ErrorDetails) -> str:
    """What pydantic says would be allowed, in the words of the other sentences."""
    words = {
        "model_type": "a JSON object",
        "model_attributes_type": "a JSON object",
        "dict_type": "a JSON object",
        "dataclass_type": "a JSON object",
        "list_type": "a list",
        "tuple_type": "a list",
        "string_type": "a text",
        "bool_type": "true or false",
        "int_type": "a whole number",
        "float_type": "a finite number",
        "finite_number": "a finite number",
        "array": error["msg"],
        "text": error["msg"],
    }
    return words.get(error["type"], error["msg"].removeprefix("Input should be ").removeprefix("Value error, "))
