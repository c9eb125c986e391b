"""Packages that only some rooms need: which extra brings them, told in one sentence where they are missing."""

from __future__ import annotations

import sys
from importlib.util import find_spec

from osfcore.errors import OsfError

PACKAGES = {
    "sim": ("pybullet", "embreex", "coacd", "imageio_ffmpeg"),
    "serve": ("fastapi", "fastapi_offline", "uvicorn", "viser", "websockets", "msgspec", "prometheus_client",
              "itsdangerous", "pydantic_settings", "pybullet"),
    "gym": ("gymnasium",),
    "mcap": ("foxglove",),
    "lerobot": ("pyarrow", "imageio_ffmpeg"),
    "ros": ("websockets",),
    "usd": ("pxr",),
}  # fmt: skip
_LATEST_FOR_PYBULLET = (3, 11)


class MissingExtra(OsfError):
    """Packages of an extra are not installed.

    Args:
        what: needs them, for the sentence.
        extra: of this distribution that brings them.
        missing: their import names.
    """

    def __init__(self, what: str, extra: str, missing: list[str]) -> None:
        which = "which is not installed; get it" if len(missing) == 1 else "which are not installed; get them"
        told = f"{what} needs {', '.join(missing)}, {which} with: pip install 'osf-manipulation[{extra}]'"
        if "pybullet" in missing and sys.version_info[:2] > _LATEST_FOR_PYBULLET:
            told += " under Python 3.11, the last one that PyBullet has wheels for"
        super().__init__(f"{told}.")


def need(extra: str, what: str) -> None:
    """Make sure that the packages of an extra are there, without importing them.

    Args:
        extra: of PACKAGES.
        what: needs them, for the sentence.

    Raises:
        MissingExtra: if they are not.
    """
    if lacking := missing(extra):
        raise MissingExtra(what, extra, lacking)


def told_of(error: ModuleNotFoundError, what: str) -> MissingExtra | None:
    """An import that failed, as a sentence; None if no extra brings the module.

    Args:
        error: of the import.
        what: needs the module, for the sentence.
    """
    package = (error.name or "").partition(".")[0]
    extra = next((extra for extra, packages in PACKAGES.items() if package in packages), None)
    return None if extra is None else MissingExtra(what, extra, missing(extra))


def missing(extra: str) -> list[str]:
    """Import names of packages of an extra that are not installed.

    Args:
        extra: of PACKAGES.
    """
    return [package for package in PACKAGES[extra] if find_spec(package) is None]
