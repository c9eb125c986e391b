"""The board as a known camera sees it: exact corners, or with noise, without any picture."""

import cv2
import numpy as np

from osfcore.geometry.poses import Pose, quaternion_exp
from osfcore.photo.board import Board
from osfcore.photo.calibration import Sighting

SIZE = (640, 480)
K = np.array([[560.0, 0, 323], [0, 560, 236], [0, 0, 1]])
RADIAL = -0.05
VARIED = ((35, 0), (-35, 0), (0, 35), (0, -35), (25, 25), (-20, 30))
FACING = Pose(np.zeros(3), quaternion_exp(np.array([np.pi, 0, 0])))  # board to camera, seen from straight above


def project(T_camera_board, points, intrinsics=K, radial=RADIAL):
    """Pixels of points of the board's frame."""
    x = T_camera_board.apply(points)
    x = x[:, :2] / x[:, 2:]
    return x * (1 + radial * (x**2).sum(axis=1, keepdims=True)) * intrinsics[[0, 1], [0, 1]] + intrinsics[:2, 2]


def tilted(tilt_deg, place_m=(0.0, 0.0, 0.45)):
    """`T_camera_board` of a board tilted about the picture's x and y axes."""
    return Pose(np.array(place_m), quaternion_exp(np.deg2rad([*tilt_deg, 0.0]))) @ FACING


def sighting(name, T_camera_board, noise_px=0.0, rng=None, intrinsics=K, size=SIZE):
    corners = Board().corners_m()
    pixels = project(T_camera_board, np.pad(corners, ((0, 0), (0, 1))), intrinsics)
    if rng is not None:
        pixels = pixels + rng.normal(0, noise_px, pixels.shape)
    return Sighting(name, size, corners, pixels)


def sightings(tilts_deg=VARIED, noise_px=0.0, rng=None, intrinsics=K):
    """One for each tilt, at slightly different places; named a.jpg, b.jpg and so on."""
    places = [(0.03 * np.cos(n), 0.03 * np.sin(n), 0.45 + 0.02 * np.cos(3 * n)) for n in range(len(tilts_deg))]
    poses = [tilted(tilt, place) for tilt, place in zip(tilts_deg, places, strict=True)]
    return [sighting(f"{chr(97 + n)}.jpg", pose, noise_px, rng, intrinsics) for n, pose in enumerate(poses)]


def on_table(found, pixels):
    """Where rays through pixels meet z = 0, as a calibration has it [m]."""
    distortion = np.array([found.lens.radial, 0, 0, 0])
    x = cv2.undistortPoints(pixels[:, None], found.lens.intrinsics, distortion)[:, 0]
    T = found.T_world_camera
    rays = T.apply(np.pad(x, ((0, 0), (0, 1)), constant_values=1.0)) - T.position
    return T.position + rays * (-T.position[2] / rays[:, 2:])
