"""Checks shapes and types of arrays while tests run: `pytest -p tests.typecheck`, part of `make test-all`.

Only what is annotated with jaxtyping is checked, for tests pass stand-ins for the rest; not in constructors, nor in
tests marked `wrong_arrays`, which show how such arrays are refused; and not in modules with compiled kernels, for
Numba compiles no function that is wrapped.
"""

import re
from collections.abc import Iterator
from pathlib import Path

import jaxtyping
import pytest
from beartype import beartype

_SOURCE = Path(__file__).parent.parent
_ARRAY = re.compile(r"\b(Float|Int|UInt|Bool|Shaped)\d*\[")
_WORD = re.compile(r"\w+")


def checked(function):
    """The function with its arrays checked."""
    hints = getattr(function, "__annotations__", {})
    known = getattr(function, "__globals__", {})
    arrays = {name: hint for name, hint in hints.items() if _is_array(str(hint), known)}
    if function.__name__ == "__init__" or not arrays:
        return function
    function.__annotations__ = arrays
    return beartype(function)


def _is_array(hint: str, known: dict[str, object]) -> bool:
    """Whether an annotation names arrays, by jaxtyping or by a name that a module has given such a type."""
    return bool(_ARRAY.search(hint)) or any(hasattr(known.get(word), "dim_str") for word in _WORD.findall(hint))


@pytest.fixture(autouse=True)
def _wrong_arrays_pass(request, monkeypatch):
    if request.node.get_closest_marker("wrong_arrays"):
        monkeypatch.setattr(jaxtyping.config, "jaxtyping_disable", True)


def _modules() -> Iterator[str]:
    for path in (_SOURCE / "osfcore").rglob("*.py"):
        if path.name != "__init__.py" and "numba" not in path.read_text():
            yield ".".join(path.relative_to(_SOURCE).with_suffix("").parts)


jaxtyping.install_import_hook(list(_modules()), f"{__name__}.checked")
