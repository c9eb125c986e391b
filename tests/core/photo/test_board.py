"""The printed board: camera and lens of photographs, its page, and pose and focal length from points of a plane."""

import re

import cv2
import numpy as np
import pytest

from osfcore.errors import InvalidInput, UnknownName
from osfcore.experiments.board_views import board_errors, board_photograph, random_camera
from osfcore.geometry.poses import rotation_angle
from osfcore.photo.board import (
    RULER_M,
    Board,
    SeenPrint,
    board_of,
    board_pdf,
    board_points,
    board_view,
    focal_length,
    locate_board,
    locate_board_through_lens,
    page_image,
    planar_pose,
    print_in,
)
from osfcore.photo.lens import Lens
from tests.support.errors import about

VGA = (640, 480)
BOARD = Board()


@pytest.fixture(scope="module")
def slanted():
    """A photograph from 0.6 m at 45 degrees."""
    rng = np.random.default_rng(7)
    return board_photograph(rng, VGA, BOARD, random_camera(rng, VGA, (0.6, 0.6), (45, 45)))


def covered(view, *rectangles):
    """The photograph with grey rectangles on the table over it, each from one corner to the opposite one [m]."""
    image = view.image.copy()
    for (x0, y0), (x1, y1) in rectangles:
        pixels = seen((view.T_world_camera, view.intrinsics), np.array([[x0, y0], [x1, y0], [x1, y1], [x0, y1]]))
        cv2.fillConvexPoly(image, np.round(pixels).astype(np.int32), (120, 110, 100))
    return image


def seen(camera, points_m):
    """Where a camera, a pose and its K, shows points of the table."""
    pose, intrinsics = camera
    projected = pose.inverse().apply(np.pad(points_m, ((0, 0), (0, 1)))) @ intrinsics.T
    return projected[:, :2] / projected[:, 2:]


def assert_near(found, true, angle_deg=0.2, distance_m=0.002):
    assert np.rad2deg(rotation_angle(found.T_world_camera.quaternion, true.T_world_camera.quaternion)) < angle_deg
    assert np.linalg.norm(found.T_world_camera.position - true.T_world_camera.position) < distance_m


@pytest.mark.parametrize(
    ("size", "count", "factor"),
    [(VGA, 3, 2), *(pytest.param(*case, 1, marks=pytest.mark.slow) for case in ((VGA, 40), ((1280, 960), 20)))],
)
def test_19_of_20_cameras_are_found_within_a_tenth_of_a_degree_and_a_millimetre(size, count, factor):
    errors = board_errors(count, np.random.default_rng(int(count > 3)), size)
    found = np.isfinite(errors.rotation_rad)
    assert found.mean() > 0.98
    for values, bound in ((np.rad2deg(errors.rotation_rad), 0.1), (errors.nearby_m, 0.0005), (errors.camera_m, 0.001)):
        assert np.percentile(values[found], 95) < factor * bound
    assert np.median(errors.rms_px[found]) < 0.1
    assert np.median(errors.corners[found]) == len(BOARD.corners_m())


def test_grey_photographs_and_parts_of_them_give_the_same_camera(slanted):
    part = cv2.cvtColor(slanted.image, cv2.COLOR_RGB2GRAY)[11:-3, 7:-20]
    intrinsics = slanted.intrinsics - np.array([[0, 0, 7], [0, 0, 11], [0, 0, 0]])
    view = locate_board(part, BOARD, intrinsics)
    assert_near(view, slanted)
    assert np.abs(seen((slanted.T_world_camera, intrinsics), view.points_m) - view.points_px).max() < 0.2


def test_large_photographs_give_the_same_camera_however_small_the_board_is(slanted):
    large = cv2.resize(slanted.image, None, fx=6, fy=6, interpolation=cv2.INTER_CUBIC)
    assert_near(locate_board(large, BOARD, np.diag([6, 6, 1]) @ slanted.intrinsics), slanted)
    large = np.full((3000, 4000, 3), 110, np.uint8)
    large[1000:1480, 2000:2640] = slanted.image
    intrinsics = slanted.intrinsics + np.array([[0, 0, 2000], [0, 0, 1000], [0, 0, 0]])
    assert_near(locate_board(large, BOARD, intrinsics), slanted)


@pytest.mark.parametrize(
    "board", [Board(7, 5, 0.036, 0.027, "DICT_5X5_50"), *(Board(*n, 0.036, 0.027) for n in ((7, 5), (6, 5), (5, 4)))]
)
def test_a_board_of_another_layout_is_refused_unless_it_is_given(board):
    """Its first markers are those of the default one, at another scale."""
    rng = np.random.default_rng(3)
    view = board_photograph(rng, VGA, board, random_camera(rng, VGA, (0.5, 0.5), (50, 50)))
    assert_near(locate_board(view.image, board, view.intrinsics), view)
    with pytest.raises(InvalidInput, check=about("board in the photograph")):
        locate_board(view.image, BOARD, view.intrinsics)


def test_unknown_focal_length_is_estimated(slanted):
    view = locate_board(slanted.image, BOARD)
    true = slanted.intrinsics[0, 0]
    assert 0 < view.focal_std_px < 0.02 * true
    assert abs(view.intrinsics[0, 0] - true) < 3 * view.focal_std_px
    assert_near(view, slanted, angle_deg=0.5, distance_m=0.01)


def test_things_on_the_board_do_not_move_the_camera_unless_they_hide_most_of_it(slanted):
    view = locate_board(covered(slanted, ((-0.2, -0.2), (-0.05, 0.01))), BOARD, slanted.intrinsics)
    assert 6 <= view.corner_count < 15
    assert_near(view, slanted, angle_deg=0.5, distance_m=0.005)
    with pytest.raises(InvalidInput, check=about("number of corners")):
        locate_board(covered(slanted, ((-0.2, -0.2), (0.0, 0.2)), ((-0.02, 0.025), (0.2, 0.2))), BOARD)


def test_photographs_without_a_sharp_board_are_refused(slanted):
    noise = np.random.default_rng(0).integers(0, 256, (480, 640, 3)).astype(np.uint8)
    blurred = cv2.GaussianBlur(slanted.image, (0, 0), 6)
    for image, why in ((noise, "board"), (slanted.image[:, ::-1].copy(), "board"), (blurred, "blur")):
        with pytest.raises(InvalidInput, check=about(why)):
            locate_board(image, BOARD)


@pytest.mark.wrong_arrays
def test_what_is_no_photograph_and_wrong_intrinsics_are_refused(slanted):
    for image in (np.zeros((480, 640, 3)), np.zeros((480, 640, 4), np.uint8), np.zeros(9, np.uint8)):
        with pytest.raises(InvalidInput, check=about("photograph")):
            locate_board(image, BOARD)
    found = board_points(slanted.image, BOARD)
    for intrinsics in (np.eye(2), np.diag([0, 1, 1]), np.full((3, 3), np.nan), np.ones((3, 3))):
        with pytest.raises(InvalidInput, check=about("intrinsics")):
            board_view(found, VGA, intrinsics)
    with pytest.raises(InvalidInput, check=about("mean distance of the print's points")):
        board_view(found, VGA, np.diag([3, 3, 1]) @ slanted.intrinsics)


@pytest.mark.parametrize(
    ("wrong", "what"),
    [
        ({"columns": 2}, "squares"),
        ({"columns": 21, "dictionary": "DICT_4X4_1000"}, "squares"),
        ({"square_m": 1.5, "marker_m": 1.0}, "square_m"),
        ({"square_m": float("nan")}, "board"),
        ({"marker_m": 0.044}, "marker_m"),
        ({"columns": 20, "rows": 15, "square_m": 0.012, "marker_m": 0.009}, "squares"),
        ({"dictionary": "DICT_4x4_50"}, "DICT_4x4_50"),
    ],
)
def test_boards_that_cannot_be_are_refused(wrong, what):
    with pytest.raises((InvalidInput, UnknownName), check=about(what)):
        Board(**wrong)


def test_a_board_that_is_larger_than_the_page_is_not_printed():
    with pytest.raises(InvalidInput, check=about("side of the board")):
        page_image(Board(square_m=0.05, marker_m=0.04), 1000)


# Boards of others.


OTHERS = [
    Board(5, 4, 0.04, 0.03, "DICT_6X6_250", legacy=True),
    Board(6, 4, legacy=True),
    Board(7, 5, 0.036, 0.02, "DICT_5X5_1000"),
    Board(8, 5, 0.03, 0.022, "DICT_APRILTAG_36h11"),
]


@pytest.mark.parametrize("board", OTHERS, ids=str)
def test_another_board_is_named_and_found_once_it_is_described(board):
    rng = np.random.default_rng(5)
    view = board_photograph(rng, (960, 720), board, random_camera(rng, (960, 720), (0.5, 0.5), (50, 60)))
    with pytest.raises(InvalidInput, match=f"{board.columns} x {board.rows} squares") as refused:
        locate_board(view.image, BOARD, view.intrinsics)
    form = re.search(r"\d+x\d+,SQUARE,MARKER,\w+(,legacy)?", str(refused.value)).group()
    described = board_of(form.replace("SQUARE", str(board.square_m)).replace("MARKER", str(board.marker_m)))
    assert described.legacy == board.legacy
    assert_near(locate_board(view.image, described, view.intrinsics), view)


@pytest.mark.parametrize("rising", [False, True])
def test_a_grid_of_markers_is_told_from_a_board(rising):
    """Kalibr's grids count their rows from the bottom."""
    numbers = np.arange(20).reshape(5, 4)[:: -1 if rising else 1]
    tags = cv2.aruco.getPredefinedDictionary(cv2.aruco.DICT_APRILTAG_36h11)
    markers = [[np.pad(tags.generateImageMarker(int(n), 80), 15, constant_values=255) for n in row] for row in numbers]
    seen = print_in(np.pad(np.block(markers), 60, constant_values=255))
    assert seen == SeenPrint(4, 5, "DICT_APRILTAG_36h11", "rising grid" if rising else "grid", seen.marker)
    assert seen.marker == pytest.approx(80 / 110, abs=0.02)
    assert not seen.is_charuco


def test_a_photograph_without_markers_shows_no_print(slanted):
    assert print_in(np.full((480, 640), 128, np.uint8)) is None
    assert print_in(cv2.cvtColor(slanted.image, cv2.COLOR_RGB2GRAY)).is_of(BOARD)


def test_a_board_is_described_by_its_squares_sides_and_dictionary():
    assert board_of("5x7,0.04,0.03,DICT_5X5_100") == Board(5, 7, 0.04, 0.03, "DICT_5X5_100")
    assert board_of("8 X 6, 0.1, 0.08, DICT_4X4_250, legacy") == Board(8, 6, 0.1, 0.08, "DICT_4X4_250", legacy=True)
    assert board_of("") == Board()


@pytest.mark.parametrize(
    ("text", "what"),
    [
        ("5x7", "board"),
        ("5x7,40 mm,30 mm,DICT_5X5_100", "board"),
        ("5x7,0.04,0.03", "board"),
        ("5x7,0.04,0.03,DICT_5X5_100,old", "end"),
        ("5x7,40,30,DICT_5X5_100", "square_m"),
        ("5x7,0.04,0.05,DICT_5X5_100", "marker_m"),
        ("5x7,0.04,0.03,5X5_100", "5X5_100"),
    ],
)
def test_what_describes_no_board_is_refused(text, what):
    with pytest.raises((InvalidInput, UnknownName), check=about(what)):
        board_of(text)


# Distortion of a lens, from the board in one photograph.


K = np.array([[560.0, 0, 320], [0, 560, 240], [0, 0, 1]])


def near_view(radial, seed=4):
    rng = np.random.default_rng(seed)
    pose, _ = random_camera(rng, VGA, (0.4, 0.4), (45, 50))
    return board_photograph(rng, VGA, BOARD, (pose, K), radial=radial)


@pytest.mark.parametrize(("radial", "is_known"), [(-0.05, True), (0.1, False)])
def test_distortion_is_found_and_the_camera_with_it(radial, is_known):
    view = near_view(radial)
    found, lens = locate_board_through_lens(view.image, BOARD, K if is_known else None)
    assert abs(lens.radial - radial) < min(0.03, 4 * lens.std)
    straight = locate_board(view.image, BOARD, K)
    distances = [np.linalg.norm(v.T_world_camera.position - view.T_world_camera.position) for v in (found, straight)]
    assert distances[0] < (0.001 if is_known else 0.005)
    assert not is_known or distances[0] < distances[1]


def test_without_distortion_the_camera_is_the_same_and_a_focal_length_that_the_board_contradicts_is_refused():
    plain = near_view(0.0).image
    found, lens = locate_board_through_lens(plain, BOARD, K)
    assert lens.radial == 0
    assert lens.straightened(plain) is plain
    np.testing.assert_array_equal(found.T_world_camera.matrix(), locate_board(plain, BOARD, K).T_world_camera.matrix())
    for factor in (0.5, 1.3):
        with pytest.raises(InvalidInput, check=about("focal length of the photo")):
            locate_board_through_lens(plain, BOARD, K * [[factor], [factor], [1]])
    assert locate_board_through_lens(plain, BOARD, K * [[1.04], [1.04], [1]])[1].radial == 0  # no distortion either


@pytest.mark.parametrize("radial", [-0.08, 0.12])
def test_straightening_moves_what_is_bent_back(radial):
    lens, straight = Lens(K, (radial,)), np.array([[100.5, 60.5], [320.5, 240.5], [500.5, 400.5]])
    rows, columns = np.mgrid[:480, :640] + 0.5
    spots = [np.exp(-((columns - x) ** 2 + (rows - y) ** 2) / 18) for x, y in lens.bent(straight)]
    flat = lens.straightened(np.sum(spots, axis=0).astype(np.float32))
    for x, y in straight:
        near = flat * ((columns - x) ** 2 + (rows - y) ** 2 < 15**2)
        centre = np.array([(near * columns).sum(), (near * rows).sum()]) / near.sum()
        assert np.linalg.norm(centre - (x, y)) < 0.2


@pytest.mark.slow
@pytest.mark.parametrize("radial", [-0.05, 0.1])
def test_cameras_behind_lenses_are_found_several_times_better(radial):
    bent, plain = (board_errors(8, np.random.default_rng(5), VGA, radial=k) for k in (radial, 0.0))
    assert np.isfinite(bent.rotation_rad).mean() > 0.9
    assert np.rad2deg(np.nanmedian(bent.rotation_rad)) < 0.03
    assert np.nanmedian(bent.nearby_m) < 0.001
    assert np.rad2deg(np.nanpercentile(plain.rotation_rad, 95)) < 0.04


# The page to print.


DOT_M = 0.0254 / 600


def edges(line):
    return np.flatnonzero(np.diff(line.astype(int))) + 1


def test_pdf_is_a_page_of_a4_in_landscape_and_small():
    pdf = board_pdf(BOARD)
    (box,) = re.findall(rb"/MediaBox \[ ?([\d. ]+)\]", pdf)
    np.testing.assert_allclose(np.array(box.split(), float) / 72 * 25.4, (0, 0, 297, 210), atol=0.1)
    assert len(pdf) < 300_000


@pytest.mark.parametrize("board", [BOARD, Board(7, 5, 0.036, 0.027, "DICT_5X5_50")], ids=str)
def test_board_has_its_exact_size_in_the_middle_of_the_page(board):
    page = page_image(board, 1 / DOT_M)
    np.testing.assert_allclose(np.array(page.shape[::-1]) * DOT_M, (0.297, 0.21), atol=5e-5)
    at = (np.array([0.297, 0.21]) / 2 + board.corners_m() * (1, -1)) / DOT_M
    inside = 0.04 * board.square_m / DOT_M
    for x, y in at[:: len(at) - 1]:  # the first and the last corner: colours change exactly there
        across = page[round(y - inside), round(x - inside) : round(x + inside)]
        down = page[round(y - inside) : round(y + inside), round(x - inside)]
        assert edges(across) + round(x - inside) == pytest.approx([x], abs=1)
        assert edges(down) + round(y - inside) == pytest.approx([y], abs=1)
    rows, columns = (np.flatnonzero(~page.all(axis=axis)) * DOT_M for axis in (1, 0))
    assert min(rows[0], columns[0], 0.297 - columns[-1]) > 0.008


def test_ruler_is_100_mm_long_and_does_not_touch_the_board():
    page = page_image(BOARD, 1 / DOT_M)
    below = page[round((0.105 + 0.088 + 0.001) / DOT_M) :]
    longest = max(np.diff(edges(row))[::2].max() for row in below if not row.all())  # runs of ink between two edges
    assert longest * DOT_M == pytest.approx(RULER_M, abs=4e-4)


# Pose and focal length from points of a plane.


POINTS = np.stack(np.meshgrid(np.linspace(-0.1, 0.1, 5), np.linspace(-0.06, 0.06, 3)), axis=-1).reshape(-1, 2)


@pytest.mark.parametrize("points", [POINTS, POINTS[[0, 4, 14, 10]]], ids=["15 points", "4 points"])
def test_pose_is_exact_for_exact_points_and_above_the_table_for_others(points):
    rng = np.random.default_rng(0)
    for _ in range(10):
        pose, intrinsics = camera = random_camera(rng, VGA)
        found, rms = planar_pose(points, seen(camera, points), intrinsics)
        assert rotation_angle(found.quaternion, pose.quaternion) < 1e-5
        assert np.linalg.norm(found.position - pose.position) < 1e-5
        assert rms < 1e-3
        camera = random_camera(rng, VGA, elevations_deg=(70, 90))
        assert planar_pose(POINTS, seen(camera, POINTS) + rng.normal(0, 1, POINTS.shape), camera[1])[0].position[2] > 0


def test_a_view_from_below_is_refused_and_a_focal_length_from_straight_above():
    pose, intrinsics = random_camera(np.random.default_rng(2), VGA)
    with pytest.raises(InvalidInput, check=about("side of the print")):
        planar_pose(POINTS, seen((pose, intrinsics), POINTS) * (-1, 1) + (VGA[0], 0), intrinsics)
    rng = np.random.default_rng(5)
    for noise_px in (0.0, 0.1, 0.1):
        pixels = seen(random_camera(rng, VGA, elevations_deg=(87, 90)), POINTS)
        with pytest.raises(InvalidInput, check=about("focal length")):
            focal_length(POINTS, pixels + rng.normal(0, noise_px, pixels.shape), VGA, accuracy_px=0.05)


def test_focal_length_is_exact_for_exact_points_and_its_deviation_is_its_scatter():
    rng = np.random.default_rng(3)
    for _ in range(5):
        camera = random_camera(rng, VGA, elevations_deg=(30, 60))
        focal, deviation = focal_length(POINTS, seen(camera, POINTS), VGA, accuracy_px=0.01)
        assert focal == pytest.approx(camera[1][0, 0], rel=1e-3)
        assert 0 < deviation < 0.01 * focal
    camera = random_camera(rng, VGA, elevations_deg=(45, 45))
    noisy = (seen(camera, POINTS) + rng.normal(0, 0.1, POINTS.shape) for _ in range(100))
    focals, deviations = np.array([focal_length(POINTS, pixels, VGA, 0.01) for pixels in noisy]).T
    assert np.std(focals) == pytest.approx(np.median(deviations), rel=0.3)
    assert abs(np.mean(focals) - camera[1][0, 0]) < 0.5 * np.std(focals)
