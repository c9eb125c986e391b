"""The default data directory."""

import os
from pathlib import Path

import platformdirs


def default_data_dir() -> Path:
    """Return the folder for all data of the program: OSF_DATA_DIR if set, else the user's data folder for osf."""
    chosen = os.environ.get("OSF_DATA_DIR")
    return Path(chosen).expanduser() if chosen else platformdirs.user_data_path("osf")
