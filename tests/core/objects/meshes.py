"""Mesh files made by hand."""

import numpy as np


def msh_bytes(vertices, uv, faces, normals=()) -> bytes:
    """The contents of a MuJoCo .msh file, v downwards."""
    floats = [np.asarray(array, np.float32).reshape(-1) for array in (vertices, normals, uv)]
    counts = np.array([len(vertices), len(normals), len(uv), len(faces)], np.int32)
    return b"".join(array.tobytes() for array in (counts, *floats, np.asarray(faces, np.int32)))
