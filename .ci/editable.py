"""Build hook: in a checkout that is installed with `pip install -e`, osf_app is the folder app as it stands."""

from __future__ import annotations

from pathlib import Path
from tempfile import mkdtemp
from typing import Any

from hatchling.builders.hooks.plugin.interface import BuildHookInterface


class EditableHook(BuildHookInterface):
    """Adds a package osf_app whose modules are those of the folder app, since hatchling renames in wheels only."""

    def initialize(self, version: str, build_data: dict[str, Any]) -> None:
        """Extend what goes into an editable install."""
        if version == "editable":
            package = Path(mkdtemp()) / "__init__.py"
            package.write_text(f"__path__ = [{str(Path(self.root, 'app'))!r}]\n", encoding="utf-8")
            build_data["force_include_editable"] = {str(package): "osf_app/__init__.py"}
