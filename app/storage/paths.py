"""Where data lies on this machine, and how sentences name it to those who need not know."""

import re
from pathlib import Path

from osfcore.objects.data_dir import default_data_dir

__all__ = ["default_data_dir", "static_folder", "without_places"]

_SEPARATORS = r"[/\\]+"  # Windows has the other one, twice where a message shows a path as Python writes it


def static_folder() -> Path:
    """The page's files: inside the installed package, or at the top of a checkout."""
    here = Path(__file__).parents[1]
    packaged = here / "static"
    return packaged if packaged.is_dir() else here.parent / "static"


def without_places(text: str, data_dir: Path) -> str:
    """A sentence in which paths begin at the data directory or at the program's packages, instead of at the root."""
    for place in dict.fromkeys((data_dir.absolute(), data_dir.resolve())):
        text = _from(place, "the data directory", text)
    return _from(Path(__file__).parents[2], "the program", text)


def _from(place: Path, name: str, text: str) -> str:
    """The text with paths from a place on, and with a name for the place itself."""
    path = r"(?<![\w./\\-])" + _SEPARATORS.join(re.escape(part) for part in re.split(_SEPARATORS, str(place)))
    text = re.sub(path + _SEPARATORS, "", text)
    text = re.sub(rf"{path}(?![\w-]|\.\w)", name, text)
    return text[:1].upper() + text[1:] if text.startswith(name) else text
