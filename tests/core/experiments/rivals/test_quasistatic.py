import numpy as np
import pytest
import torch

from osfcore.dynamics.motion import Motion
from osfcore.dynamics.shapes import MAP_SIDE, ObjectShape, ShapeTable, octahedral_directions
from osfcore.experiments.rivals.quasistatic import push
from osfcore.geometry import torch_rotations as rotations
from osfcore.geometry.polygons import circle, gap_between, gap_to_point
from osfcore.geometry.poses import quaternion_exp
from osfcore.geometry.workspace import PUSHER_RADIUS_M
from tests.core.dynamics.scenes import crowd, start

BRICK, DISC = np.array([0.03, 0.05, 0.02]), 0.04


def plain(kind: str) -> ObjectShape:
    d = octahedral_directions(MAP_SIDE)
    if kind == "brick":
        points = np.where(d >= 0, BRICK, -BRICK)
    else:
        flat = d[:, :2] / np.maximum(np.linalg.norm(d[:, :2], axis=1, keepdims=True), 1e-9)
        points = np.concatenate([DISC * flat, np.where(d[:, 2:] >= 0, 0.02, -0.02)], axis=1)
    return ObjectShape(np.ptp(points, axis=0) / 2, np.zeros(3), 0.07, points.astype(np.float32))


TABLE = ShapeTable((plain("brick"), plain("disc")))
NUMBERS = {"brick": 0, "disc": 1}


def motion_of(placed, pusher=(0.0, 0.0)):
    number = torch.tensor([[NUMBERS[kind] for kind, *_ in placed]])
    centre = torch.tensor([[[x, y, 0.02] for _, x, y, _ in placed]], dtype=torch.float32)
    turned = quaternion_exp(np.array([[0, 0, angle] for *_, angle in placed], float))
    still = torch.zeros_like(centre)
    floor = torch.zeros(1, len(placed))
    quaternion = torch.as_tensor(turned, dtype=torch.float32)[None]
    return number, Motion(centre, quaternion, still, still, torch.tensor([pusher], dtype=torch.float32), floor)


def pushed(placed, shifts, pusher=(0.0, 0.0)):
    number, motion = motion_of(placed, pusher)
    *_, last = push(TABLE, number, motion, torch.tensor(np.array(shifts), dtype=torch.float32)[:, None])
    return motion, last


def outline_of(kind, motion, slot) -> torch.Tensor:
    flat = torch.nn.functional.pad(circle(64), (0, 1))
    rotation = rotations.matrix(motion.quaternion[:, slot])
    around = TABLE.farthest(torch.tensor([NUMBERS[kind]]), rotation, flat)[..., :2]
    return around + motion.centre[:, None, slot, :2]


def yaw(motion, slot) -> float:
    w, z = motion.quaternion[0, slot, 0], motion.quaternion[0, slot, 3]
    return 2 * float(torch.atan2(z, w))


@pytest.mark.parametrize("angle", [0.0, -2.5])
@pytest.mark.parametrize(("kind", "half"), [("brick", BRICK[0]), ("disc", DISC)])
def test_through_the_centre_it_moves_as_far_as_the_pusher_after_contact(kind, half, angle):
    gap, travel = 0.006, 0.06
    way = np.array([np.cos(angle), np.sin(angle)])
    place = (half + PUSHER_RADIUS_M + gap) * way
    before, after = pushed([(kind, *place, angle)], [0.25 * travel * way] * 4)
    np.testing.assert_allclose(
        (after.centre - before.centre)[0, 0, :2], (travel - gap) * way, atol=2e-3 if kind == "disc" else 5e-4
    )
    assert abs(yaw(after, 0) - angle) % (2 * np.pi) == pytest.approx(0, abs=0.05)
    np.testing.assert_allclose(after.pusher[0], travel * way, atol=1e-6)


def test_a_pushed_object_pushes_the_next_one():
    before, after = pushed(
        [("disc", 0.06, 0.0, 0.0), ("disc", 0.145, 0.0, 0.0), ("brick", 0.225, 0.0, 0.0)], [[0.01, 0.0]] * 6
    )
    way = (after.centre - before.centre)[0, :, 0]
    np.testing.assert_allclose(way, [0.055, 0.05, 0.04], atol=4e-3)  # less the gaps of 5, 5 and 10 mm


@pytest.mark.parametrize("seed", range(3))
def test_nothing_is_left_penetrating(seed):
    rng = np.random.default_rng(seed)
    placed = [
        ("brick", 0.07, rng.uniform(-0.03, 0.03), rng.uniform(-3, 3)),
        ("disc", 0.19, rng.uniform(-0.03, 0.03), 0.0),
    ]
    _, after = pushed(placed, [[0.012, rng.uniform(-0.004, 0.004)]] * 8)
    first, second = outline_of("brick", after, 0), outline_of("disc", after, 1)
    assert float(gap_between(first, second).distance) > -1e-3
    for outline in (first, second):
        assert float(gap_to_point(outline, after.pusher).distance) > PUSHER_RADIUS_M - 1e-3


def test_a_push_beside_the_centre_turns_it_and_a_pusher_that_leaves_moves_nothing():
    for y, sign in ((0.03, -1), (-0.03, 1)):
        before, after = pushed([("brick", 0.046, y, 0.0)], [[0.01, 0.0]] * 2)
        assert sign * yaw(after, 0) < 0  # hit below its centre, it turns to the left
        assert torch.equal(pushed([("brick", 0.046, y, 0.0)], [[-0.015, 0.0], [0.0, 0.0]])[1].centre, before.centre)


def test_in_a_mirror_it_slides_in_the_mirror():
    here = pushed([("brick", 0.06, 0.01, 0.4), ("disc", 0.16, 0.0, 0.0)], [[0.012, 0.003]] * 5)[1]
    there = pushed([("brick", 0.06, -0.01, -0.4), ("disc", 0.16, 0.0, 0.0)], [[0.012, -0.003]] * 5)[1]
    np.testing.assert_allclose(here.centre[0] * torch.tensor([1, -1, 1]), there.centre[0], atol=2e-3)
    assert yaw(here, 0) == pytest.approx(-yaw(there, 0), abs=0.03)


def test_heights_and_tilts_stay_and_quaternions_are_unit(shapes, table):
    number, motion = start(table, shapes, crowd(shapes))
    shifts = torch.tensor([[[0.012, 0.002]]] * 5)
    for after in push(table, number, motion, shifts):
        assert torch.equal(after.centre[..., 2], motion.centre[..., 2])
        torch.testing.assert_close(after.quaternion.norm(dim=-1), torch.ones(1, 4))
    box = crowd(shapes).names.index("003_cracker_box")
    assert torch.equal(after.centre[0, box], motion.centre[0, box])
    assert (after.centre - motion.centre)[0, :, 0].amax() > 0.03


def test_many_scenes_at_once_are_the_same_as_one_by_one(shapes, table):
    number, motion = start(table, shapes, crowd(shapes))
    twice = motion._make(part.repeat(2, *[1] * (part.dim() - 1)) for part in motion)
    shifts = torch.tensor([[[0.012, 0.002], [0.012, -0.004]]] * 4)
    together = list(push(table, number.repeat(2, 1), twice, shifts))
    assert len(together) == 4
    for row in range(2):
        alone = list(push(table, number, motion, shifts[:, row : row + 1]))
        torch.testing.assert_close(together[-1].centre[row], alone[-1].centre[0], atol=2e-4, rtol=0)
