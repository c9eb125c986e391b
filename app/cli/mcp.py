"""`osf mcp`: a running service as tools for an assistant that speaks the Model Context Protocol."""

from __future__ import annotations

import os
from dataclasses import dataclass
from importlib.metadata import version
from typing import Any

from osfcore.extras import need

from .command import Command


@dataclass(frozen=True)
class Mcp(Command):
    """Offer a running service to an assistant over standard input and output; the assistant starts this command."""

    url: str = "http://127.0.0.1:8000"
    """Address of the service."""
    token: str | None = None
    """Of the service, if it has one (also: OSF_TOKEN)."""

    def run(self) -> dict[str, Any]:
        """Answer until the assistant closes standard input."""
        need("mcp", "This command")
        from osfcore.contrib.client import Client
        from osfcore.contrib.mcp_server import mcp_server

        with Client(self.url, token=self.token or os.environ.get("OSF_TOKEN")) as osf:
            mcp_server(osf, version("osf-manipulation")).run("stdio")
        return {"url": self.url}
