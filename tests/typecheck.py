"""Checks shapes and types of arrays while tests run; `make test-all` names this module to jaxtyping.

Only what is annotated with jaxtyping is checked, for tests pass stand-ins for the rest; and neither constructors nor
functions that refuse wrong arrays themselves, for tests give them such arrays on purpose.
"""

import re

from beartype import beartype

_ARRAY = re.compile(r"\b(Float|Int|UInt|Bool|Shaped)\d*\[")
_REFUSE_THEMSELVES = ("__init__", "rollout", "unit_quaternion")


def checked(function):
    """The function with its arrays checked."""
    hints = getattr(function, "__annotations__", {})
    arrays = {name: hint for name, hint in hints.items() if _ARRAY.search(str(hint))}
    if function.__name__ in _REFUSE_THEMSELVES or not arrays:
        return function
    function.__annotations__ = arrays
    return beartype(function)
