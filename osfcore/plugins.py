"""Parts that other packages offer by entry points of the groups osf.worlds, osf.costs, osf.planners, osf.estimators.

An entry point names a factory: a class or function that takes the inputs of its kind of part (`WorldInputs`,
`CostInputs`, `PlannerInputs`, or the data directory) and returns the part. It cannot replace a part of ours.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from importlib.metadata import entry_points
from typing import TypeVar

from osfcore.errors import OsfError, UnknownName

Given = TypeVar("Given")
Part = TypeVar("Part")


@dataclass(frozen=True, slots=True)
class PartKind:
    """A kind of parts that can be replaced.

    Attributes:
        noun: for a part of this kind, such as "world".
        methods: that each part has.
    """

    noun: str
    methods: tuple[str, ...]

    @property
    def group(self) -> str:
        """Group of the entry points."""
        return f"osf.{self.noun}s"


class BrokenPlugin(OsfError):
    """A part of another package that cannot be used.

    Args:
        kind: of the part.
        name: of the part.
        packages: that offer it.
        reason: why not.
    """

    def __init__(self, kind: PartKind, name: str, packages: str, reason: str) -> None:
        super().__init__(
            f"The {kind.noun} {name!r} of the package {packages} cannot be used: {reason}; repair or uninstall it."
        )
        self.name, self.packages, self.reason = name, packages, reason


def part_names(kind: PartKind, own: Mapping[str, object]) -> tuple[str, ...]:
    """Return the names of our parts, then those of other packages."""
    return (*own, *sorted(entry_points(group=kind.group).names - own.keys()))


def part_factory(kind: PartKind, name: str, own: Mapping[str, Callable[[Given], Part]]) -> Callable[[Given], Part]:
    """Return the factory of a part.

    Args:
        kind: of the part.
        name: of the part.
        own: our factories, by name.

    Raises:
        UnknownName: if nobody offers the part.
        BrokenPlugin: if it cannot be loaded, or two packages offer it. The factory raises it, too, if the part cannot
            be made or lacks a method.
    """
    if name in own:
        return own[name]
    found = list(entry_points(group=kind.group, name=name))
    if not found:
        raise UnknownName(kind.noun, name, part_names(kind, own))
    packages = " and ".join(sorted({"of unknown name" if one.dist is None else one.dist.name for one in found}))
    if len(found) > 1:
        raise BrokenPlugin(kind, name, packages, "both offer this name")
    try:
        factory: Callable[[Given], Part] = found[0].load()
    except Exception as error:
        raise BrokenPlugin(kind, name, packages, _reason(error)) from error

    def make(given: Given) -> Part:
        try:
            part = factory(given)
        except OsfError:
            raise
        except Exception as error:
            raise BrokenPlugin(kind, name, packages, _reason(error)) from error
        lacking = [method for method in kind.methods if not callable(getattr(part, method, None))]
        if lacking:
            raise BrokenPlugin(kind, name, packages, f"it has no {', '.join(lacking)}")
        return part

    return make


def _reason(error: Exception) -> str:
    return f"{type(error).__name__}: {error}".rstrip(".: ")
