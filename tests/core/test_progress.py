import dataclasses

import pytest

from osfcore.progress import Progress


def test_steps_are_frozen():
    with pytest.raises(dataclasses.FrozenInstanceError):
        Progress(1, 2, "working").done = 2  # pyright: ignore[reportAttributeAccessIssue]
