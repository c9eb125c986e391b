"""Runs tests as if on another system: `pytest -p tests.elsewhere`, for files of tests that do not test Linux itself."""

import os
import runpy
from pathlib import Path

_HERE = Path(__file__).parent

os.environ["PYTHONPATH"] = os.pathsep.join(filter(None, (str(_HERE), os.environ.get("PYTHONPATH"))))  # of children
runpy.run_path(str(_HERE / "sitecustomize.py"))
