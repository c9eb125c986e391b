"""A photograph of a table with the board and one object on it, drawn by the simulator."""

import numpy as np

from osfcore.estimation.camera_response import srgb_of_linear
from osfcore.experiments.board_views import board_photograph
from osfcore.geometry.cameras import Camera
from osfcore.geometry.poses import Pose
from osfcore.io.image_file import to_uint8
from osfcore.photo.board import Board
from osfcore.render.renderer import SceneRenderer
from osfcore.render.types import SceneBatch

SIZE = (640, 480)
K = np.array([[560.0, 0, 320], [0, 560, 240], [0, 0, 1]])


def table_photo(fields, name, pose, eye, **options):
    """Encoded photo, mask of the object, camera's pose; `options` are of `board_photograph`."""
    T_world_camera = Camera.look_at("photo", np.array(eye), np.array([0.05, 0, 0])).T_world_camera
    view = board_photograph(np.random.default_rng(0), SIZE, Board(), (T_world_camera, K), **options)
    light = np.array([[0.48, -0.36, 0.8]])
    batch = SceneBatch((name,), pose.position[None, None], pose.quaternion[None, None], light, None)
    drawn = SceneRenderer(fields, None).render(
        batch, [Camera("photo", T_world_camera, K, *SIZE)], outputs={"rgb", "masks"}
    )
    mask = drawn.masks[0, 0, 0]
    encoded = np.where(mask[..., None], to_uint8(srgb_of_linear(drawn.rgb[0, 0])), view.image)
    return encoded.astype(np.uint8), mask, T_world_camera


def on_the_table(field, x, y):
    """A pose upright on the table."""
    return Pose(np.array([x, y, (field.extent[1, 2] - field.extent[0, 2]) / 2]), np.array([0.8, 0, 0, 0.6]))
