"""Tell for which systems and Pythons everything that osf-manipulation[serve] needs is to be had as wheels.

`make check-wheels` runs it; it needs the network, and reads what packages say of themselves without downloading them.
"""

import os
import subprocess
import sys
from pathlib import Path

PROJECT = Path(__file__).parents[1] / "pyproject.toml"
SYSTEMS = {
    "Linux, x86-64": "x86_64-manylinux_2_28",
    "Linux, ARM": "aarch64-manylinux_2_28",
    "macOS 14, Apple silicon": "aarch64-apple-darwin",
    "Windows, x86-64": "x86_64-pc-windows-msvc",
}
PYTHONS = ("3.11", "3.12", "3.13", "3.14")
EXTRAS = {"the library": (), "[serve]": ("--extra", "serve")}


def lacking(system, python, extra):
    """What uv says is missing, None if nothing is."""
    command = ["uv", "pip", "compile", "--quiet", str(PROJECT), *extra, "--python-platform", system]
    command += ["--python-version", python, "--only-binary", ":all:", "--output-file", os.devnull]
    environment = dict(os.environ, MACOSX_DEPLOYMENT_TARGET="14.0", COLUMNS="10000")
    done = subprocess.run(command, env=environment, capture_output=True, text=True, check=False)
    return None if done.returncode == 0 else done.stderr.strip()


def main():
    reasons = {}
    print("{:<38}".format("") + "".join("{:<6}".format(python) for python in PYTHONS))
    for label, extra in EXTRAS.items():
        for name, system in SYSTEMS.items():
            told = {python: lacking(system, python, extra) for python in PYTHONS}
            found = ("yes" if reason is None else "no" for reason in told.values())
            print("{:<38}".format(label + ", " + name) + "".join("{:<6}".format(word) for word in found), flush=True)
            reasons.update({(label, name, python): reason for python, reason in told.items() if reason is not None})
    for place, reason in reasons.items():
        print("\n" + ", ".join(place) + ": " + reason, file=sys.stderr)
    return 1 if reasons else 0


if __name__ == "__main__":
    sys.exit(main())
