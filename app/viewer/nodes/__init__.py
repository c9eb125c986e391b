"""Nodes of the 3D scene: what is drawn, without threads or GUI."""
