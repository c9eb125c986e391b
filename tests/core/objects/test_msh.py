import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from osfcore.errors import CorruptFile
from osfcore.objects.mesh import read_msh

VERTICES = np.array([[0, 0, 0], [0.1, 0, 0], [0, 0.1, 0], [0, 0, 0.1]], np.float32)
UV = np.array([[0, 0], [1, 0], [0, 1], [0.25, 0.75]], np.float32)
FACES = np.array([[0, 2, 1], [0, 1, 3], [0, 3, 2], [1, 2, 3]], np.int32)


def msh_bytes(vertices=VERTICES, normals=None, uv=UV, faces=FACES) -> bytes:
    normals = np.zeros((0, 3), np.float32) if normals is None else normals
    counts = np.array([len(vertices), len(normals), len(uv), len(faces)], np.int32)
    return b"".join(a.tobytes() for a in (counts, vertices, normals, uv, faces))


@pytest.mark.parametrize("normals", [None, np.ones((4, 3), np.float32)])
def test_reads_what_was_written_and_turns_v(tmp_path, normals):
    path = tmp_path / "a.msh"
    path.write_bytes(msh_bytes(normals=normals))
    mesh = read_msh(path)
    np.testing.assert_array_equal(mesh.vertices, VERTICES)
    np.testing.assert_array_equal(mesh.faces, FACES)
    np.testing.assert_array_equal(mesh.uv, np.stack([UV[:, 0], 1 - UV[:, 1]], axis=1))


@given(st.binary(max_size=200))
def test_any_other_bytes_are_refused(tmp_path_factory, data):
    path = tmp_path_factory.mktemp("msh") / "a.msh"
    path.write_bytes(data)
    with pytest.raises(CorruptFile, match=r"a\.msh"):
        read_msh(path)


@pytest.mark.parametrize("cut", [1, 4, 40])
def test_a_truncated_file_is_refused(tmp_path, cut):
    path = tmp_path / "a.msh"
    path.write_bytes(msh_bytes()[:-cut])
    with pytest.raises(CorruptFile, match="bytes long instead of"):
        read_msh(path)


def test_missing_texture_coordinates_are_refused(tmp_path):
    path = tmp_path / "a.msh"
    path.write_bytes(msh_bytes(uv=UV[:0]))
    with pytest.raises(CorruptFile, match="0 texture coordinates for 4 vertices"):
        read_msh(path)
