"""What the learned parts are compared with."""

from importlib.resources import files
from pathlib import Path

from osfcore.errors import OsfError


def repository_weights(name: str, own: str) -> Path:
    """Return weights of a rival that are in the repository, and not in the wheel.

    Args:
        name: of the file or folder.
        own: where a user may put weights instead.

    Raises:
        OsfError: if they are not there, as in an installed wheel.
    """
    path = Path(str(files(__name__) / "shipped" / name))
    if not path.exists():
        raise OsfError(
            f"The weights of this rival are not part of the installed package; take {name} out of the repository's "
            f"osfcore/experiments/rivals/shipped and put it at {own}, or train it as "
            "docs/explanation/evaluation.md says."
        )
    return path
