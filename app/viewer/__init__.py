"""The live 3D view. This room and the relay are the only importers of viser."""

from .viewer import Viewer as Viewer
