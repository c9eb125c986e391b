"""Checks of errors by their fields, so that tests leave the wording of sentences free."""

from collections.abc import Callable


def about(subject: str) -> Callable[[BaseException], bool]:
    """Return a check for `pytest.raises(..., check=...)`: one of the error's fields names the subject."""
    return lambda error: any(subject in str(field) for field in vars(error).values())
