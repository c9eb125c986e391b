"""Scenes and fields as files that other programs open: binary glTF, USD and Gaussian splats."""
