"""Recordings of what happened on a table, for viser's own player: one file that needs no service."""

from __future__ import annotations

import contextlib
import io
from collections.abc import Iterable
from pathlib import Path

import viser

from osfcore.geometry.states import SceneState
from osfcore.geometry.workspace import STEP_S
from osfcore.io.files import write_atomically
from osfcore.objects.asset_library import AssetLibrary

from ..viewer.nodes.room import add_room
from ..viewer.nodes.scene_nodes import SceneNodes


def write_recording(path: Path, library: AssetLibrary, states: Iterable[SceneState]) -> None:
    """Write a `.viser` file that plays true states, one every 0.2 s.

    Args:
        path: of the file.
        library: meshes, sizes and labels of the objects.
        states: one or more, of the same objects.

    Raises:
        CannotWrite: if the disk refuses.
    """
    first, *later = states
    with contextlib.redirect_stdout(io.StringIO()):  # viser greets
        server = viser.ViserServer(host="127.0.0.1", port=0, verbose=False)
    try:
        add_room(server)
        drawing = SceneNodes(server, library)
        drawing.show(first)
        serializer = server.get_scene_serializer()
        for state in later:
            serializer.insert_sleep(STEP_S)
            drawing.place(state)
        serializer.insert_sleep(STEP_S)
        write_atomically(path, serializer.serialize())
    finally:
        with contextlib.redirect_stdout(io.StringIO()):  # viser says goodbye
            server.stop()
