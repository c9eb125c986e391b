"""Cameras from files of other programs, each written as the program writes it."""

import json

import cv2
import numpy as np
import pytest

from osfcore.errors import CorruptFile, InvalidInput
from osfcore.photo.camera_files import read_camera
from tests.support.errors import about

FX, FY, CX, CY = 615.25, 616.5, 318.75, 241.5
K = np.array([[FX, 0, CX], [0, FY, CY], [0, 0, 1]])
D = (-0.0565, 0.0677, 0.0002, 0.0007, -0.0218)
WIDE = (-0.02, 0.012, -0.009, 0.002)
RATIONAL = (0.45, -2.7, 0.0006, -0.0002, 1.6, 0.33, -2.5, 1.5)
ROWS, LINE = K.tolist(), K.ravel().tolist()
SIZE = (640, 480)

ROS = f"""image_width: 640
image_height: 480
camera_name: narrow_stereo
camera_matrix:
  rows: 3
  cols: 3
  data: {LINE}
distortion_model: MODEL
distortion_coefficients:
  rows: 1
  cols: 5
  data: DATA
rectification_matrix: {{rows: 3, cols: 3, data: [1, 0, 0, 0, 1, 0, 0, 0, 1]}}
projection_matrix: {{rows: 3, cols: 4, data: [600, 0, 320, 0, 0, 600, 240, 0, 0, 0, 1, 0]}}
"""
ECHO = f"""header:
  stamp: {{sec: 1, nanosec: 2}}
  frame_id: camera_color_optical_frame
height: 480
width: 640
distortion_model: rational_polynomial
d: {list(RATIONAL)}
k: {LINE}
r: [1.0, 0.0, 0.0, 0.0, 1.0, 0.0, 0.0, 0.0, 1.0]
p: [600.0, 0.0, 320.0, 0.0, 0.0, 600.0, 240.0, 0.0, 0.0, 0.0, 1.0, 0.0]
binning_x: 0
---
"""
PART = ECHO.replace(str(CX), str(CX + 8)).replace(str(CY), str(CY + 6))
PART = PART.replace("---", "roi: {x_offset: 8, y_offset: 6, width: 600, height: 400, do_rectify: false}")
KALIBR = f"""cam0:
  cam_overlaps: []
  camera_model: pinhole
  distortion_coeffs: {list(WIDE)}
  distortion_model: equidistant
  intrinsics: [{FX}, {FY}, {CX}, {CY}]
  resolution: [640, 480]
  rostopic: /cam0/image_raw
"""
AZURE = {"fx": FX, "fy": FY, "cx": CX, "cy": CY, "metric_radius": 1.7, "codx": 0, "cody": 0}
AZURE |= dict(zip(("k1", "k2", "p1", "p2", "k3", "k4", "k5", "k6"), RATIONAL, strict=True))
REALSENSE = {"width": 640, "height": 480, "ppx": CX, "ppy": CY, "fx": FX, "fy": FY, "coeffs": [0.0] * 5}
CASES = {
    "ros1.yaml": (ROS.replace("MODEL", "plumb_bob").replace("DATA", str(list(D))), D, False, SIZE),
    "e.yaml": (ROS.replace("MODEL", "plumb_bob").replace("DATA", "[-1e-05, 0, 0, 0]"), (-1e-5, 0, 0, 0), False, SIZE),
    "fisheye.yaml": (ROS.replace("MODEL", "equidistant").replace("DATA", str([*WIDE, 0.0])), WIDE, True, SIZE),
    "ros2.yml": (ECHO, RATIONAL, False, SIZE),
    "camchain.yaml": (KALIBR, WIDE, True, SIZE),
    "cam_K.txt": ("\n".join(" ".join(f"{v:.18e}" for v in row) for row in ROWS) + "\n", (), False, None),
    "commas.txt": (",".join(map(str, LINE)), (), False, None),
    "realsense.json": ({**REALSENSE, "model": "distortion.inverse_brown_conrady"}, (), False, SIZE),
    "azure.json": ({"width": 640, "height": 480, "intrinsics": {"parameters": AZURE}}, RATIONAL, False, SIZE),
    "bop.json": ({"cx": CX, "cy": CY, "fx": FX, "fy": FY, "height": 480, "width": 640}, (), False, SIZE),
    "happypose.json": ({"K": ROWS, "resolution": [480, 640]}, (), False, SIZE),
    "open3d.json": ({"width": 640, "height": 480, "intrinsic_matrix": K.T.ravel().tolist()}, (), False, SIZE),
    "ndds.json": ({"camera_settings": [{"intrinsic_settings": {"fx": FX, "fy": FY, "cx": CX, "cy": CY, "s": 0},
                   "captured_image_size": {"width": 640, "height": 480}}]}, (), False, SIZE),
    "capitals.yaml": (KALIBR.replace("pinhole", "PINHOLE"), WIDE, True, SIZE),
    "type.yaml": (KALIBR.replace("distortion_model", "distortion_type"), WIDE, True, SIZE),
    "tutorial.json": ({"camera_matrix": ROWS, "dist_coeff": [list(D)]}, D, False, None),
    "printed.txt": (str(ROWS).replace(",", ""), (), False, None),
    "scannet.txt": ("".join(f"{x} {y} {z} 0\n" for x, y, z in ROWS) + "0 0 0 1\n", (), False, None),
    "part.yaml": (PART, RATIONAL, False, (600, 400)),
    "lists.json": ({"camera_matrix": ROWS, "distCoeffs": [list(D)], "imageSize": [640, 480]}, D, False, SIZE),
}  # fmt: skip


@pytest.mark.parametrize("name", CASES)
def test_each_form_is_read(tmp_path, name):
    content, coefficients, is_fisheye, size = CASES[name]
    (tmp_path / name).write_text(content if isinstance(content, str) else json.dumps(content))
    camera = read_camera(tmp_path / name)
    np.testing.assert_allclose(camera.lens.intrinsics, K + [[0, 0, 0.5], [0, 0, 0.5], [0, 0, 0]], atol=1e-9)
    np.testing.assert_allclose(camera.lens.coefficients, coefficients)
    assert (camera.lens.is_fisheye, camera.size, camera.T_world_camera) == (is_fisheye, size, None)


@pytest.mark.parametrize("suffix", [".yaml", ".yml", ".json"])
def test_what_opencv_writes_is_read(tmp_path, suffix):
    path = tmp_path / f"calib{suffix}"
    storage = cv2.FileStorage(str(path), cv2.FileStorage_WRITE)
    for name, value in (("image_width", 640), ("image_height", 480), ("flags", 0)):
        storage.write(name, value)
    storage.write("camera_matrix", K)
    storage.write("distortion_coefficients", np.array([D]).T)
    storage.release()
    camera = read_camera(path)
    np.testing.assert_allclose(camera.lens.intrinsics[:2, 2], (CX + 0.5, CY + 0.5))
    np.testing.assert_allclose(camera.lens.coefficients, D)
    assert camera.size == SIZE


def test_a_matrix_alone_is_of_the_photo_as_it_was_sent(tmp_path):
    (tmp_path / "cam_K.txt").write_text(" ".join(map(str, LINE)))
    camera = read_camera(tmp_path / "cam_K.txt")
    np.testing.assert_allclose(camera.lens_at(SIZE).intrinsics[0, 2], CX + 0.5)
    for size, what in (((1280, 960), "principal point"), ((480, 640), "principal point")):
        with pytest.raises(InvalidInput, check=about(what)):
            camera.lens_at(size)


@pytest.mark.parametrize(
    ("name", "content", "what"),
    [
        ("a.yaml", ROS.replace("MODEL", "fov").replace("DATA", "[0.9, 0.1, 0, 0, 0]"), "fov"),
        ("a.yaml", ROS.replace("MODEL", "plumb_bob").replace("DATA", "[.1, .1, .1, .1, .1, .1]"), "distortion"),
        ("a.yaml", ROS.replace("MODEL", "plumb_bob").replace("DATA", "none"), "distortion"),
        ("a.yaml", KALIBR + KALIBR.replace("cam0", "cam1"), "number of cameras"),
        ("a.yaml", KALIBR.replace("pinhole", "omni"), "omni"),
        ("a.yaml", "a: [1, 2\nb", "neither JSON nor YAML"),
        ("a.yaml", "- 1", "ROS's camera_info"),
        ("a.yaml", "", "ROS's camera_info"),
        ("a.yaml", "&a [*a]", "ROS's camera_info"),
        ("a.yaml", "&a {cam0: *a}", "camera_matrix, K"),
        ("a.yaml", "&a {k: *a}", "K of the camera"),
        ("a.yaml", "!!python/object/apply:os.getcwd []", "neither JSON nor YAML"),
        ("a.yaml", KALIBR.replace("pinhole", "ds").replace("[", "[-0.2, 0.5, "), "ds"),
        ("a.yaml", ROS.replace("distortion_model: MODEL", "").replace("DATA", "[-.1, .2, .1, -.3]"), "equidistant"),
        ("a.yaml", ECHO.replace("---", "roi: {width: [1, 2], height: 3}"), "roi"),
        ("ost.txt", "# oST version 5.0 parameters\n\n\n[image]\n\nwidth\n640\n", "cameracalibrator.py"),
        ("a.json", {"camera_settings": [{}, {}]}, "number of cameras"),
        ("a.txt", "600 0 320 1 0 600 240 0 0 0 1 0", "12 numbers"),
        ("a.xml", "<?xml version='1.0'?><opencv_storage/>", "XML"),
        ("a.txt", "1 0 0 0 1 0", "6 numbers"),
        ("a.txt", "", "ROS's camera_info"),
        ("a.json", {"frames": [], "fl_x": 600.0}, "camera_matrix, K"),
        ("a.json", {**REALSENSE, "model": "distortion.inverse_brown_conrady", "coeffs": [0.1, 0, 0, 0, 0]}, "inverse"),
        ("a.json", {**REALSENSE, "fx": [1, 2]}, "K of the camera"),
        ("a.json", {**REALSENSE, "width": 640.5}, "size of the pictures"),
        ("a.json", {**REALSENSE, "height": None}, "size of the pictures"),
        ("a.json", {**REALSENSE, "fx": 3.0}, "focal length"),
        ("a.json", {"K": [[600, 2, 320], [0, 600, 240], [0, 0, 1]]}, "skew"),
        ("a.json", {**REALSENSE, "skew": 1.5}, "skew"),
        ("a.json", {**REALSENSE, "s": "none"}, "skew"),
        ("a.json", {"intrinsics": {"parameters": 3}}, "RealSense"),
    ],
)
def test_files_that_are_no_camera_are_refused(tmp_path, name, content, what):
    (tmp_path / name).write_text(content if isinstance(content, str) else json.dumps(content))
    with pytest.raises(CorruptFile, check=about(what)):
        read_camera(tmp_path / name)
