"""Errors: each message is one sentence that names the wrong value and what is allowed.

Every error is an `OsfError`. The command line and REST show its text unchanged. Constructors take the facts, keep them
as attributes, and write the sentence.
"""

import difflib
from collections.abc import Collection, Iterable, Sequence
from pathlib import Path

import numpy as np
from jaxtyping import Float

MAX_SEED = 2**63 - 1
_MOST_CHARACTERS = 2000  # of a sentence, however long the names in it are
_VALUE_CHARACTERS = 300  # of a value that was given, which may be a path or a list
_SHOWN_CHARACTERS = 100
_MOST_NEAR = 3  # names that may have been meant


def shown(value: object, most: int = _SHOWN_CHARACTERS) -> str:
    """Return a value as text for a message: one line of printable characters, cut in the middle if it is long."""
    text = str(value)
    if len(text) > most:
        text = f"{text[: most * 2 // 3]}...{text[-most // 3 :]}"
    return "".join(c if c.isprintable() else c.encode("unicode_escape").decode() for c in text)


def _listed(names: Iterable[str]) -> str:
    return ", ".join(sorted(names)) or "none"


def _rebuilt(kind: type["OsfError"], sentence: str, facts: dict[str, object]) -> "OsfError":
    error = kind.__new__(kind, sentence)
    error.__dict__.update(facts)
    return error


def _meant(name: str, known: list[str]) -> str:
    """Return a question about known names that contain the given one or are spelt like it; "" if there are none."""
    if not isinstance(name, str) or not 0 < len(name) <= _SHOWN_CHARACTERS:
        return ""
    near = [one for one in known if name.lower() in one.lower()] or difflib.get_close_matches(name, known, cutoff=0.7)
    return f" did you mean {' or '.join(near[:_MOST_NEAR])}?" if near else ""


class OsfError(ValueError):
    """Base of all errors of this library: a wrong input, described in one sentence that a user can act on.

    It is a `ValueError`. `str(error)` is the sentence.

    Example:
        >>> try:
        ...     fields.load("mustard")
        ... except OsfError as error:
        ...     print(error)
        There is no field named 'mustard'; did you mean 006_mustard_bottle? known: ...
    """

    def __init__(self, sentence: str = "") -> None:
        super().__init__(shown(sentence, _MOST_CHARACTERS))

    def __reduce__(self) -> tuple[object, ...]:
        """Pickle the sentence and the facts, so that a worker process can send the error."""
        return _rebuilt, (type(self), str(self), self.__dict__)


class InvalidInput(OsfError):
    """A value outside what is allowed.

    Args:
        what: name of the value, with its unit if it has one.
        value: the value that was given.
        allowed: description of what is allowed.
    """

    def __init__(self, what: str, value: object, allowed: str) -> None:
        super().__init__(f"{what} is {shown(value, _VALUE_CHARACTERS)}, but it must be {allowed}.")
        self.what = what


class UnknownName(OsfError):
    """A name that does not exist.

    Args:
        kind: kind of thing that has the name, such as "object" or "camera".
        name: the name that was given.
        known: the names that exist.
    """

    def __init__(self, kind: str, name: str, known: Iterable[str]) -> None:
        known = list(known)
        self.kind, self.name = kind, name
        meant = _meant(name, known)
        super().__init__(f"There is no {kind} named {shown(repr(name))};{meant} known: {_listed(known)}.")


class NotThere(UnknownName):
    """An identifier that does not exist, most often because its thing was deleted. People do not see identifiers.

    Args:
        kind: kind of thing, such as "scene".
    """

    def __init__(self, kind: str) -> None:
        OsfError.__init__(self, f"There is no such {kind}; it may have been deleted.")
        self.kind = kind


class MissingAssets(OsfError):
    """Objects of the catalogue whose meshes have not been fetched.

    Args:
        names: names of the objects.
    """

    def __init__(self, names: Iterable[str]) -> None:
        self.names = sorted(names)
        super().__init__(
            f"The meshes of these objects are not on this machine: {_listed(self.names)}; "
            "fetch them in Your objects on the page, or with 'osf assets fetch'."
        )


class OverlappingObjects(OsfError):
    """Two bodies that penetrate each other.

    Args:
        first: name of one body.
        second: name of the other.
        depth_m: depth of penetration [m].
    """

    def __init__(self, first: str, second: str, depth_m: float) -> None:
        self.first, self.second = first, second
        super().__init__(f"{first} and {second} overlap by {1000 * depth_m:.0f} mm; move one of them away.")


class NoRoom(OsfError):
    """Objects for which no layout without overlaps was found in the workspace.

    Args:
        names: names of the objects.
        tries: number of layouts that were tried.
    """

    def __init__(self, names: Iterable[str], tries: int) -> None:
        super().__init__(
            f"No room was found in the workspace for {_listed(names)} after {tries} tries; "
            "take fewer or smaller objects."
        )


class CorruptFile(OsfError):
    """A file or archive whose contents cannot be used.

    Args:
        path: the file.
        reason: why it cannot be used.
    """

    def __init__(self, path: Path | str, reason: str) -> None:
        super().__init__(f"{path} cannot be used: {reason}.")
        self.path, self.reason = str(path), reason


class CannotWrite(OsfError):
    """A file or folder that cannot be written. What was there before is unchanged.

    Args:
        path: the file or folder.
        reason: why it cannot be written.
    """

    def __init__(self, path: Path | str, reason: str) -> None:
        super().__init__(f"{path} cannot be written: {reason}.")
        self.path, self.reason = str(path), reason


class WorkerDied(OsfError):
    """A worker process that died in the middle of its work.

    Args:
        what: what it was doing.
    """

    def __init__(self, what: str) -> None:
        super().__init__(f"A worker process died while {what}; start it again, with fewer workers if memory ran out.")


class FetchFailed(OsfError):
    """A download that failed, or could not be verified or written. Nothing was changed.

    Args:
        what: what should have been fetched.
        reason: why it failed.
    """

    def __init__(self, what: str, reason: str) -> None:
        super().__init__(f"{what} could not be fetched: {reason}. Nothing was changed.")
        self.what, self.reason = what, reason


def finite_vector(value: object, size: int, what: str) -> Float[np.ndarray, "size"]:
    """Return a float64 copy of a vector after checking it.

    Args:
        value: anything that NumPy can turn into an array.
        size: number of components.
        what: name of the value for the error, with its unit.

    Raises:
        InvalidInput: if there are not exactly `size` numbers, or one is NaN or infinite.
    """
    try:
        vector = np.array(value, dtype=float)
    except (TypeError, ValueError, OverflowError):
        raise InvalidInput(what, repr(value)[:80], f"{size} finite numbers") from None
    if vector.shape != (size,) or not np.all(np.isfinite(vector)):
        raise InvalidInput(what, repr(vector.tolist())[:80], f"{size} finite numbers")
    return vector


def check_ranges(*limits: tuple[str, float, float, float]) -> None:
    """Check that numbers are in their ranges. NaN is not.

    Args:
        limits: name, value, least and largest allowed value of each number.

    Raises:
        InvalidInput: for the first number that is out of range.
    """
    for what, value, low, high in limits:
        if not low <= value <= high:
            raise InvalidInput(what, value, f"between {low} and {high}")


def check_seed(value: int) -> int:
    """Return a seed after checking that every random generator takes it.

    Raises:
        InvalidInput: if it is negative or has more than 63 bits.
    """
    check_ranges(("seed", value, 0, MAX_SEED))
    return int(value)


def check_unique(what: str, names: Sequence[str], allowed: str = "without repetition") -> None:
    """Check that no name occurs twice.

    Raises:
        InvalidInput: if a name does.
    """
    if len(set(names)) != len(names):
        raise InvalidInput(what, ", ".join(names), allowed)


def check_known(kind: str, names: Iterable[str], known: Collection[str]) -> None:
    """Check that names exist.

    Args:
        kind: kind of thing that has the names, such as "object" or "camera".
        names: the names that were given.
        known: the names that exist.

    Raises:
        UnknownName: for the first name that is not known.
    """
    for name in names:
        if name not in known:
            raise UnknownName(kind, name, known)
