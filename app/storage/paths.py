"""Where data lies on this machine."""

import os
from pathlib import Path

import platformdirs


def default_data_dir() -> Path:
    """The folder for everything that the program keeps: OSF_DATA_DIR if set, else the user's data folder for osf."""
    chosen = os.environ.get("OSF_DATA_DIR")
    return Path(chosen).expanduser() if chosen else platformdirs.user_data_path("osf")


def static_folder() -> Path:
    """The page's files: inside the installed package, or at the top of a checkout."""
    here = Path(__file__).parents[1]
    packaged = here / "static"
    return packaged if packaged.is_dir() else here.parent / "static"
