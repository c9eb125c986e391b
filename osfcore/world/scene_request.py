"""What a random scene shall contain, and whether it can."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float

from osfcore.errors import InvalidInput, MissingAssets, OsfError
from osfcore.geometry.light import Light
from osfcore.geometry.states import MAX_OBJECTS
from osfcore.geometry.workspace import TABLE_SIDE_M
from osfcore.objects.asset_library import AssetLibrary

MAX_HEIGHT_M = 1.0  # of an object's centre when it is put somewhere by hand


@dataclass(frozen=True, eq=False, slots=True)
class SceneRequest:
    """What a random scene shall contain.

    Attributes:
        names: the objects, or None for a random choice.
        count: how many objects, where `names` is None.
        light: the light, or None for a random one at least 10 deg above the table.
        among: what to choose from, where `names` is None; all objects of the library if None.
    """

    names: tuple[str, ...] | None = None
    count: int = 3
    light: Light | None = None
    among: tuple[str, ...] | None = None


def check_object(library: AssetLibrary, name: str) -> None:
    """Check that an object's mesh is on this machine.

    Raises:
        UnknownName: if the catalogue does not know it.
        MissingAssets: if its mesh has not been fetched.
    """
    if not library.has(name):
        library.info(name)  # raises UnknownName for what no catalogue knows
        raise MissingAssets([name])


def check_request(library: AssetLibrary, request: SceneRequest) -> None:
    """Check that a request can be met.

    Raises:
        UnknownName, MissingAssets, InvalidInput: if it cannot.
    """
    if request.names is not None:
        if not 1 <= len(request.names) <= MAX_OBJECTS:
            raise InvalidInput("number of objects", len(request.names), f"between 1 and {MAX_OBJECTS}")
        if len(set(request.names)) != len(request.names):
            raise InvalidInput("list of objects", ", ".join(request.names), "without repetition")
        for name in request.names:
            check_object(library, name)
        return
    if not 1 <= request.count <= MAX_OBJECTS:
        raise InvalidInput("number of objects", request.count, f"between 1 and {MAX_OBJECTS}")
    choice = library.names() if request.among is None else request.among
    for name in request.among or ():
        check_object(library, name)
    if len(set(choice)) != len(choice):
        raise InvalidInput("list of objects", ", ".join(choice), "without repetition")
    available = len(choice)
    if request.among is None and available == 0:
        raise OsfError("There are no objects on this machine yet; get them with 'osf assets fetch'.")
    if request.count > available:
        raise InvalidInput(
            "number of objects", request.count, f"at most {available}, as many as there are to choose from"
        )


def check_place(name: str, position: Float[np.ndarray, "3"]) -> None:
    """Check that an object may be put somewhere by hand [m].

    Raises:
        InvalidInput: if the place is not over the table.
    """
    half = TABLE_SIDE_M / 2
    if np.abs(position[:2]).max() > half or not 0 <= position[2] <= MAX_HEIGHT_M:
        allowed = f"over the table: |x|, |y| at most {half:g} and z between 0 and {MAX_HEIGHT_M:g}"
        raise InvalidInput(f"position of {name} [m]", np.round(position, 4).tolist(), allowed)
