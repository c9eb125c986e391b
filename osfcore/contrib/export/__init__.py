"""Scenes, fields and episodes as files for other programs: binary glTF, USD, Gaussian splats, LeRobot."""
