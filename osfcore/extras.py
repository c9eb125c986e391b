"""Packages that only some parts need: which extra brings them, and one sentence where they are missing."""

from __future__ import annotations

import sys
from importlib.util import find_spec

from osfcore.errors import OsfError

PACKAGES = {
    "sim": ("mujoco", "coacd"),
    "serve": ("fastapi", "uvicorn", "viser", "websockets", "msgspec", "prometheus_client",
              "itsdangerous", "pydantic_settings", "mujoco"),
    "gym": ("gymnasium",),
    "mcap": ("foxglove",),
    "heic": ("pillow_heif",),
    "video": ("imageio_ffmpeg",),
    "lerobot": ("pyarrow",),
    "ros": ("websockets",),
    "usd": ("pxr",),
    "mcp": ("mcp",),
    "slurm": ("submitit",),
    "experiments": ("matplotlib", "jinja2"),
    "pusht": ("gym_pusht", "pytorch_mppi", "pymunk", "pygame", "shapely"),
}  # fmt: skip
# gym-pusht itself comes on top: it would bring an OpenCV that overwrites the headless build.
_SECOND_STEPS = {"pusht": "pip install --no-deps gym-pusht==0.1.8"}
_WHERE_THERE_IS_ONE = {"pybullet": "sim"}  # packages that an extra brings only where they can be installed
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
        sentence = f"{what} needs {', '.join(missing)}, {which} with: pip install 'osf-manipulation[{extra}]'"
        if extra in _SECOND_STEPS:
            sentence += f" && {_SECOND_STEPS[extra]}"
        if "pybullet" in missing and sys.version_info[:2] > _LATEST_FOR_PYBULLET:
            sentence += " under Python 3.11, the last one that PyBullet has wheels for"
        super().__init__(f"{sentence}.")
        self.extra, self.missing = extra, missing


def need(extra: str, what: str) -> None:
    """Check that the packages of an extra are installed, without importing them.

    Args:
        extra: of PACKAGES.
        what: needs them, for the sentence.

    Raises:
        MissingExtra: if they are not.
    """
    if lacking := missing(extra):
        raise MissingExtra(what, extra, lacking)


def as_missing_extra(error: ModuleNotFoundError, what: str) -> MissingExtra | None:
    """Explain an import that failed; None if no extra brings the module.

    Args:
        error: of the import.
        what: needs the module, for the sentence.
    """
    package = (error.name or "").partition(".")[0]
    for extra, packages in PACKAGES.items():
        if package in packages:
            return MissingExtra(what, extra, missing(extra))
    if package in _WHERE_THERE_IS_ONE:
        return MissingExtra(what, _WHERE_THERE_IS_ONE[package], [package])
    return None


def missing(extra: str) -> list[str]:
    """Return the import names of packages of an extra that are not installed.

    Args:
        extra: of PACKAGES.
    """
    return [package for package in PACKAGES[extra] if find_spec(package) is None]
