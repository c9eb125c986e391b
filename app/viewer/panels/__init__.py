"""Panels of the viewer: GUI folders, and the threads that keep their nodes up to date."""
