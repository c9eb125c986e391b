"""`osf demo`: from nothing to a moving page."""

from __future__ import annotations

import os
import sys
import threading
import webbrowser
from dataclasses import dataclass
from typing import Any

from osfcore.extras import need

from .assets import AssetsFetch
from .command import DataCommand
from .serve import Serve, bound_socket, check_memory


@dataclass(frozen=True)
class Demo(DataCommand):
    """Fetch what is missing, start the service, and open its page. Ctrl-C stops it."""

    port: int = 8000
    """Port of the page; 0 takes a free one."""
    source: str = "pypi"
    """Where objects come from, as for 'osf assets fetch'."""
    browser: bool = True
    """Whether to open the page where there is a screen, or where BROWSER names a browser."""

    def run(self) -> dict[str, Any]:
        """Fetch and serve until interrupted."""
        serve = Serve(port=self.port, data_dir=self.data_dir, json=self.json)
        # What would stop the service is said before anything is downloaded.
        need("serve", "This command")
        check_memory()
        bound_socket(serve.host, self.port).close()
        self.say("Fetching objects and compiling; later starts need neither")
        AssetsFetch(source=self.source, data_dir=self.data_dir, json=self.json).run()
        self.say("Starting the service; Ctrl-C stops it")
        return serve.serve(_open_page if self.browser else lambda _: None)


def _open_page(url: str) -> None:
    """Open the page without waiting for the browser."""
    # Without a screen, a browser of the terminal would take the place of what is printed.
    if sys.platform != "linux" or any(os.environ.get(name) for name in ("BROWSER", "DISPLAY", "WAYLAND_DISPLAY")):
        threading.Thread(target=webbrowser.open, args=(url,), daemon=True).start()
