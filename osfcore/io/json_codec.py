"""The JSON codec of all files: entries are pydantic models, and an error is one sentence.

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
_ALLOWED = {  # what is allowed, by pydantic's types of errors
    **dict.fromkeys(("model_type", "model_attributes_type", "dict_type", "dataclass_type"), "a JSON object"),
    **dict.fromkeys(("list_type", "tuple_type"), "a list"),
    **dict.fromkeys(("float_type", "finite_number"), "a finite number"),
    **{"string_type": "a text", "bool_type": "true or false", "int_type": "a whole number"},
}


def _as_a_whole(allowed: str) -> WrapValidator:
    """Report an error of an array as a whole instead of its first wrong number."""

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
Vector2 = Annotated[list[FiniteFloat], Field(min_length=2, max_length=2), _as_a_whole("2 finite numbers")]
Vector3 = Annotated[list[FiniteFloat], Field(min_length=3, max_length=3), _as_a_whole("3 finite numbers")]
Vector4 = Annotated[list[FiniteFloat], Field(min_length=4, max_length=4), _as_a_whole("4 finite numbers")]
Matrix3 = Annotated[list[Vector3], Field(min_length=3, max_length=3), _as_a_whole("3 x 3 finite numbers")]
Matrix4 = Annotated[list[Vector4], Field(min_length=4, max_length=4), _as_a_whole("4 x 4 finite numbers")]


class Entry(BaseModel):
    """A JSON object with typed members; unknown members are ignored."""

    model_config = ConfigDict(extra="ignore", strict=True, frozen=True)


@cache
def _adapter(kind: type[T]) -> TypeAdapter[T]:
    return TypeAdapter(kind)


def encode(value: object) -> Any:  # noqa: ANN401
    """Return an entry or a dataclass as plain lists, numbers and texts, without members that were not set."""
    return _adapter(type(value)).dump_python(value, mode="json", exclude_unset=True)


def decode(kind: type[T], data: object, what: str, *, is_stored: bool = False) -> T:
    """Return an entry or a dataclass of parsed JSON.

    Args:
        kind: class of the result.
        data: the result of `json.loads`.
        what: name of the whole for messages, such as "scene".
        is_stored: whether a program wrote the data, perhaps another version of it. Lists are then read as tuples, and
            unknown members are ignored, even if the class refuses them.

    Raises:
        InvalidInput: for the first member that does not fit; the message names it.
    """
    try:
        if is_stored:
            return _adapter(kind).validate_python(data, strict=False, extra="ignore")
        return _adapter(kind).validate_python(data)
    except ValidationError as error:
        raise _refusal(error.errors(include_url=False)[0], data, what) from None


def _refusal(error: ErrorDetails, data: object, what: str) -> InvalidInput:
    key, owner = _place(error["loc"], data, what)
    if error["type"] == "missing":
        return InvalidInput(f"{key!r} of {owner}", "missing", "given")
    place = f"{key} of {owner}" if key and owner != what else key or owner
    stock = error["msg"].removeprefix("Input should be ").removeprefix("Value error, ")
    allowed = _ALLOWED.get(error["type"], stock)
    return InvalidInput(place, shown(repr(error["input"]), _MOST_CHARACTERS), allowed)


def _place(path: tuple[int | str, ...], data: object, what: str) -> tuple[str, str]:
    """Return the member with the error ("position") and its owner ("object 006_mustard_bottle")."""
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
