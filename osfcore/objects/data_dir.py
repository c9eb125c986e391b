"""Where data lies on this machine, unless a person says otherwise."""

import os
from pathlib import Path

import platformdirs


def default_data_dir() -> Path:
    """The folder for everything that the program keeps: OSF_DATA_DIR if set, else the user's data folder for osf."""
    chosen = os.environ.get("OSF_DATA_DIR")
    return Path(chosen).expanduser() if chosen else platformdirs.user_data_path("osf")
