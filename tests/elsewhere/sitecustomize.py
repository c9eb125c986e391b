"""Hides from this program's packages what only Linux on x86-64 has. Libraries have their own ways on each system.

Python imports a module of this name as it starts, and so does each child process.
"""

import builtins
import sys
from types import ModuleType

HIDDEN = ("fcntl", "resource")
OURS = ("app", "osf_app", "osfcore")


class System(ModuleType):
    """The module sys, as it is on macOS."""

    platform = "darwin"

    def __getattr__(self, name):
        return getattr(sys, name)


SYSTEM = System("sys")
anywhere = builtins.__import__


def elsewhere(name, globals=None, locals=None, fromlist=(), level=0):
    if globals is not None and str(globals.get("__name__")).partition(".")[0] in OURS:
        if name in HIDDEN:
            raise ModuleNotFoundError(f"No module named {name!r}", name=name)
        if name == "sys":
            return SYSTEM
    return anywhere(name, globals, locals, fromlist, level)


builtins.__import__ = elsewhere
sys.modules["embreex"] = sys.modules["pybullet"] = None  # type: ignore[assignment]
