import numpy as np
import pytest
import trimesh

from app.viewer.nodes.ghosts import (
    CELLS,
    between,
    box,
    coarse,
    footprint_m,
    heading_rad,
    mesh_of,
    moves,
    pose_at,
    sector,
    shell,
    spread,
    top_m,
)
from osfcore.geometry.poses import Pose, quaternion_exp, quaternion_multiply

TURN_Y = np.array([0.5**0.5, 0, 0.5**0.5, 0])  # +x goes down, +z to +x


def area_m2(vertices, faces):
    a, b, c = (vertices[faces[:, i]].astype(float) for i in range(3))
    return np.linalg.norm(np.cross(b - a, c - a), axis=1).sum() / 2


@pytest.mark.parametrize("name", ["006_mustard_bottle", "035_power_drill"])
def test_a_coarse_mesh_has_few_triangles_and_nearly_the_same_shape(library, name):
    mesh = library.load(name).mesh
    vertices, faces = coarse(mesh.vertices, mesh.faces)
    assert 100 < len(faces) < len(mesh.faces) / 5
    assert faces.max() < len(vertices)
    cell_m = (mesh.vertices.max(axis=0) - mesh.vertices.min(axis=0)).max() / CELLS
    assert np.abs(vertices.max(axis=0) - mesh.vertices.max(axis=0)).max() < cell_m
    assert np.abs(vertices.min(axis=0) - mesh.vertices.min(axis=0)).max() < cell_m
    assert area_m2(vertices, faces) == pytest.approx(area_m2(mesh.vertices, mesh.faces), rel=0.2)


def test_no_triangle_of_a_coarse_mesh_vanishes_or_comes_twice():
    rng = np.random.default_rng(0)
    vertices, faces = coarse(rng.normal(size=(200, 3)), rng.integers(0, 200, (500, 3)), 4)
    rows = np.sort(faces, axis=1)
    assert (np.diff(rows.astype(int), axis=1) > 0).all()
    assert len(np.unique(rows, axis=0)) == len(rows)
    assert len(vertices) <= 64


def test_a_cube_is_closed_and_faces_outward():
    vertices, faces = box(0.1)
    a, b, c = (vertices[faces[:, i]] for i in range(3))
    assert area_m2(vertices, faces) == pytest.approx(0.06)
    assert (np.einsum("ij,ij->i", np.cross(b - a, c - a), a + b + c) > 0).all()


def test_a_shell_lies_as_far_outside_as_told():
    ball = trimesh.creation.icosphere(radius=0.05)
    vertices, faces = shell((ball.vertices.astype(np.float32), ball.faces), 0.003)
    assert np.linalg.norm(vertices, axis=1) == pytest.approx(0.053, rel=1e-3)
    assert faces is ball.faces


def test_the_shell_of_a_vessel_has_no_inside():
    (outer, faces), (inner, _) = box(0.1), box(0.09)
    vertices, faces = shell((np.concatenate([outer, inner]), np.concatenate([faces, faces[:, ::-1] + 8])), 0.0)
    assert area_m2(vertices, faces) == pytest.approx(0.06)
    assert np.abs(vertices) == pytest.approx(np.full((8, 3), 0.05))


def test_a_sector_opens_as_far_as_it_is_told_and_faces_up():
    vertices, faces = sector(1.0, 0.2, 0.05, 0.08)
    headings = np.arctan2(vertices[:, 1], vertices[:, 0])
    assert (headings.min(), headings.max()) == pytest.approx((0.8, 1.2), abs=1e-6)
    reach = np.linalg.norm(vertices, axis=1)
    assert (reach.min(), reach.max()) == pytest.approx((0.05, 0.08), abs=1e-6)
    a, b, c = (vertices[faces[:, i]] for i in range(3))
    assert (np.cross(b - a, c - a)[:, 2] > 0).all()
    assert area_m2(vertices, faces) == pytest.approx(0.2 * (0.08**2 - 0.05**2), rel=0.01)


@pytest.mark.parametrize(("of", "count"), [(50, 24), (24, 24), (17, 24), (1, 3)])
def test_as_many_poses_as_wanted_are_spread_over_all(of, count):
    poses = Pose(np.arange(3.0 * of).reshape(of, 3), np.tile([1.0, 0, 0, 0], (of, 1)))
    chosen = spread(poses, count)
    assert chosen.position.shape == (count, 3)
    assert chosen.position[0, 0] == 0
    assert chosen.position[-1, 0] == 3 * (of - 1 if count > 1 else 0)
    assert len(np.unique(chosen.position[:, 0])) == min(of, count)


def test_a_turned_mesh_tells_how_far_it_reaches():
    vertices = box(1.0)[0] * np.array([0.2, 0.1, 0.06])
    upright = np.array([1.0, 0, 0, 0])
    assert top_m(vertices, upright) == pytest.approx(0.03)
    assert top_m(vertices, TURN_Y) == pytest.approx(0.1)
    assert footprint_m(vertices, upright) == pytest.approx(np.hypot(0.1, 0.05))
    assert footprint_m(vertices, TURN_Y) == pytest.approx(np.hypot(0.03, 0.05))


def test_the_heading_follows_turns_about_the_vertical():
    half = 0.35
    turn = np.array([np.cos(half), 0, 0, np.sin(half)])
    for lying in (np.array([1.0, 0, 0, 0]), TURN_Y):
        before, after = heading_rad(lying), heading_rad(quaternion_multiply(turn, lying))
        assert (after - before) % (2 * np.pi) == pytest.approx(2 * half)


def test_an_object_without_a_mesh_here_is_a_cube(library):
    mesh = library.load("006_mustard_bottle").mesh
    vertices, faces = mesh_of(library, "006_mustard_bottle", 20)
    np.testing.assert_array_equal(vertices, coarse(mesh.vertices, mesh.faces, 20)[0])
    assert len(faces) > 100
    vertices, faces = mesh_of(library, "my_thing")
    assert (len(vertices), len(faces)) == (8, 12)


@pytest.mark.parametrize(
    ("shift_m", "turn_rad", "is_seen"), [(0.0, 0.0, False), (1e-3, 0.02, False), (0.005, 0.0, True), (0.0, 0.1, True)]
)
def test_only_what_can_be_seen_to_move_moves(shift_m, turn_rad, is_seen):
    ends = np.linspace(0, 1, 5)[:, None]
    turns = quaternion_exp(ends * [0, 0, turn_rad])
    turns[1::2] *= -1  # the same rotations
    assert moves(Pose(ends * [shift_m, 0, 0], turns)) == is_seen


def test_between_two_rows_it_is_halfway_and_beyond_the_ends_it_stays():
    rows = np.array([[0.0, 1.0], [2.0, 3.0], [10.0, 11.0]])
    for step, expected in (
        (-1, [0, 1]),
        (0, [0, 1]),
        (0.5, [1, 2]),
        (1, [2, 3]),
        (1.25, [4, 5]),
        (2, [10, 11]),
        (9, [10, 11]),
    ):
        np.testing.assert_allclose(between(rows, step), expected, atol=1e-12)
    np.testing.assert_allclose(between(rows[:1], 0.7), [0, 1], atol=1e-12)


def test_a_pose_between_two_is_one_whatever_the_signs_of_their_quaternions():
    angles = np.linspace(0, 2.4, 7)
    turns = quaternion_exp(angles[:, None] * np.array([0, 0, 1.0]))
    signs = np.array([1, -1, -1, 1, -1, 1, 1])[:, None]
    poses = Pose(np.zeros((7, 3)), signs * turns)
    for step in np.linspace(0, 6, 25):
        expected = quaternion_exp(np.array([0, 0, np.interp(step, np.arange(7), angles)]))
        assert abs(pose_at(poses, step).quaternion @ expected) == pytest.approx(1, abs=1e-4)
