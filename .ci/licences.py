"""Write the table of what `pip install 'osf-manipulation[serve]'` brings, and under which licences.

Run as `python .ci/licences.py > docs/reference/licences.md`, where these packages are installed.
"""

from __future__ import annotations

import re
import tomllib
from collections.abc import Iterator
from importlib.metadata import Distribution, distribution
from pathlib import Path

from packaging.requirements import Requirement

PROJECT = "osf-manipulation"
EXTRAS = ("sim", "serve")
# What the metadata does not say: licences that are told as text, and what wheels contain besides their own code.
TOLD = {"embreex": "BSD-2-Clause"}
_GCC = "GCC's runtime: GPL-3.0-or-later WITH GCC-exception-3.1"
CONTAINED = {
    "coacd": _GCC,
    "embreex": "Embree: Apache-2.0",
    "numpy": _GCC,
    "opencv-python-headless": f"FFmpeg: LGPL-2.1-or-later; {_GCC}",
    "scipy": _GCC,
    "torch": _GCC,
}
_CUDA = ("nvidia-", "cuda-", "triton")  # come with some builds of torch only
_HEAD = f"""# Licences

The program is under the MIT licence. The table lists all that `pip install '{PROJECT}[serve]'` brings, as each package
states it; `python .ci/licences.py` has made it. No package is under the GPL or AGPL. GCC's runtime, which wheels for
Linux carry, has an exception for programs that use it. FFmpeg in OpenCV's wheel is a library of its own under the LGPL.
Builds of torch with CUDA also bring NVIDIA's libraries under NVIDIA's own licence; the CPU builds do not.

What is under the GPL comes by extras that are asked for: `heic` (pillow-heif, with libx265), and `video`
(imageio-ffmpeg, with libx264). The page's own copies of fflate and uPlot (MIT) and of Swagger UI (Apache-2.0) are in
`static/vendor`, with their licences.

| package | needed by | licence | also contains |
|---|---|---|---|
"""


def table() -> str:
    """Return the page."""
    return _HEAD + "".join(
        f"| {name} | {extra or 'core'} | {licence_of(distribution(name))} | {CONTAINED.get(name, '')} |\n"
        for name, extra in sorted(closure().items())
    )


def closure() -> dict[str, str]:
    """Return the names of all packages but those of CUDA, and the first of core and extras that needs each."""
    path = Path(__file__).parents[1] / "pyproject.toml"
    project = tomllib.loads(path.read_text(encoding="utf-8"))["project"]
    found: dict[str, str] = {}
    for extra in ("", *EXTRAS):
        wanted = project["optional-dependencies"][extra] if extra else project["dependencies"]
        for requirement in map(Requirement, wanted):
            if requirement.name != PROJECT and _applies(requirement, ()):
                for name in _with_dependencies(requirement, set()):
                    if not name.startswith(_CUDA):
                        found.setdefault(name, extra)
    return found


def licence_of(package: Distribution) -> str:
    """Return what a package states: its SPDX expression, else its classifiers, else its field."""
    told = package.metadata
    name = _normalized(told["Name"])
    classifiers = [line.rpartition(":: ")[2] for line in told.get_all("Classifier", []) if line.startswith("License")]
    return TOLD.get(name) or told.get("License-Expression") or ", ".join(classifiers) or told.get("License", "")


def _with_dependencies(requirement: Requirement, seen: set[tuple[str, frozenset[str]]]) -> Iterator[str]:
    key = _normalized(requirement.name), frozenset(requirement.extras)
    if key not in seen:
        seen.add(key)
        yield key[0]
        for inner in map(Requirement, distribution(requirement.name).requires or ()):
            if _applies(inner, requirement.extras):
                yield from _with_dependencies(inner, seen)


def _applies(requirement: Requirement, extras: set[str] | tuple[()]) -> bool:
    return requirement.marker is None or any(requirement.marker.evaluate({"extra": e}) for e in ("", *extras))


def _normalized(name: str) -> str:
    return re.sub(r"[-_.]+", "-", name).lower()


if __name__ == "__main__":
    print(table(), end="")
