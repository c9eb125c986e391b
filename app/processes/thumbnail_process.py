"""The process that draws thumbnails of objects; the service imports only `thumbnails_main`."""

from __future__ import annotations

from pathlib import Path

from .child_process import limit_memory
from .server import ProcessServer

_MEMORY_BYTES = 3 << 30  # an object with the largest texture takes one


def thumbnails_main(server: ProcessServer, objects_root: Path) -> None:
    """Draw the objects that are asked for by name; answers PNGs."""
    from osfcore.inspection.contact_sheet import turntable_png
    from osfcore.objects.asset_library import AssetLibrary

    limit_memory(_MEMORY_BYTES)
    library = AssetLibrary(objects_root)
    server.serve(lambda name, _: turntable_png(library.load(name).mesh))
