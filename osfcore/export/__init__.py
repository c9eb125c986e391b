"""Scenes and fields as files that other programs open: binary glTF and Gaussian splats."""
