"""The live 3D view. This room and the relay are the only importers of viser."""

from app.viewer.viewer import Viewer as Viewer
