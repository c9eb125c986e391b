"""Nodes that one browser does not see, while others do."""

from __future__ import annotations

import threading
from collections.abc import Collection

import viser


class HiddenNodes:
    """Hides nodes in one browser, each for as long as somebody wants that. Any thread may call.

    A node that all browsers see is covered by an invisible one of the same path that is this browser's own. A node of
    its own would be removed by that, with all below it; it becomes invisible itself.

    Args:
        client: the browser.
    """

    def __init__(self, client: viser.ClientHandle) -> None:
        self._scene = client.scene
        self._lock = threading.Lock()
        self._wanted: dict[str, frozenset[str]] = {}
        self._covers: dict[str, viser.SceneNodeHandle | None] = {}  # by path; None for a node of its own

    def hide(self, by: str, paths: Collection[str]) -> None:
        """Hide some paths, and no longer others, as far as `by` is concerned."""
        with self._lock:
            self._wanted[by] = frozenset(paths)
            every = frozenset().union(*self._wanted.values())
            for path in self._covers.keys() - every:
                self._uncover(path)
            for path in every:
                self._cover(path)

    def _cover(self, path: str) -> None:
        node = self._scene.get_handle_by_name(path)
        if node is None:
            self._covers[path] = self._scene.add_frame(path, show_axes=False, visible=False)
        elif node is not self._covers.get(path):
            self._covers[path] = None
            if node.visible:
                node.visible = False

    def _uncover(self, path: str) -> None:
        cover, node = self._covers.pop(path), self._scene.get_handle_by_name(path)
        if node is not None and node is cover:
            node.remove()
        elif node is not None and cover is None:
            node.visible = True  # else somebody else has covered it meanwhile
