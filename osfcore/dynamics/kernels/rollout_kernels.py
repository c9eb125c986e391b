"""Rollouts of many scenes, compiled: `osfcore.dynamics.substep` with all that it calls. Only `rollout.py` calls it."""
# ruff: noqa: ANN001, ANN202, D417 - compiled helpers; types are given by their callers

from __future__ import annotations

import math

import numba
import numpy as np

from osfcore.dynamics.features import SHIFT_M, TURN_RAD
from osfcore.dynamics.kernels.contact_kernels import Scenes, find_contacts, new_contacts, rotation_of
from osfcore.dynamics.kernels.feature_kernels import add_features
from osfcore.dynamics.kernels.network_kernels import MOTION_WIDTH, new_memory, predict_motions
from osfcore.dynamics.kernels.options import HALF, HELPER, KERNEL, ONE, ZERO
from osfcore.dynamics.kernels.shape_kernels import farthest_point
from osfcore.dynamics.motion import ASIDE
from osfcore.dynamics.pusher_path import SUBSTEPS
from osfcore.dynamics.recorded_states import SLEEP_M, SLEEP_RAD

_ANGLES = 2 * np.pi / 8 * np.arange(8)
_DOWN_X, _DOWN_Y = (np.float32(ASIDE) * np.append(f(_ANGLES), 0).astype(np.float32) for f in (np.cos, np.sin))
_SHIFT, _TURN = np.float32(SHIFT_M), np.float32(TURN_RAD)
_SLEEP_M, _SLEEP_RAD = np.float32(SLEEP_M), np.float32(SLEEP_RAD)
_STANDS, _RESTS, _TINY = np.float32(1e-6), np.float32(1e-9), np.float32(1e-20)


@numba.njit(**KERNEL)
def unroll_block(
    shapes, weights, number, start, begins, velocity, shifts, first, last, centre, quaternion, has_moved
) -> None:
    """Roll out some of K sequences of T actions from one state of N objects, which go through the network together.

    Args:
        shapes, weights: `Shapes`, `Weights`.
        number: shape of each object.
        start: N x 3, x 4, x 3, x 3 and N: centres, orientations, displacements, rotation vectors and floors.
        begins: K x 2, the pusher [m].
        velocity: K x T x 2, of the pusher [m/s].
        shifts: K x S x 2, of the pusher in each substep [m].
        first, last: numbers of the first sequence, and of the one after the last.
        centre, quaternion, has_moved: results after each action: K x T x N x 3, x 4, and without.
    """
    objects, size = len(number), last - first
    parts = 0
    for n in range(objects):
        parts += shapes.part_count[number[n]]
    scenes = _new_scenes(number, start, begins, first, size)
    memory = new_memory(size * objects, size * objects * objects, weights.hidden)
    contacts, scratch = new_contacts(objects, parts), np.empty((objects, 6), np.float32)
    places, frames = np.empty((size * objects, 2), np.int64), np.empty((size * objects, 5), np.float32)
    moved = np.zeros((size, objects), np.bool_)
    for step in range(shifts.shape[1]):
        nodes, edges = np.int64(0), np.int64(0)
        for b in range(size):
            k = first + b
            shift_x, shift_y = shifts[k, step, 0], shifts[k, step, 1]
            x, y = _heading(scenes, b, velocity[k, step // SUBSTEPS, 0], velocity[k, step // SUBSTEPS, 1])
            pairs = find_contacts(shapes, scenes, b, x, y, shift_x, shift_y, contacts)
            scenes.pusher[b, 0] += shift_x
            scenes.pusher[b, 1] += shift_y
            if pairs < 0:
                continue
            before = nodes
            shift_x, shift_y = x * shift_x + y * shift_y, x * shift_y - y * shift_x
            nodes, edges = add_features(
                shapes, scenes, contacts, pairs, shift_x, shift_y, scratch, memory, nodes, edges
            )
            _stop(scenes, b, contacts, scratch, x, y, places, frames, before)
        if nodes > 0:
            predict_motions(weights, memory, nodes, edges)
            for node in range(nodes):
                _move(shapes, scenes, places[node, 0], places[node, 1], frames, node, memory.motion, moved,
                      contacts.rotation)  # fmt: skip
        if (step + 1) % SUBSTEPS == 0:
            _record(scenes, moved, first, step // SUBSTEPS, centre, quaternion, has_moved)


@numba.njit(error_model="numpy")
def _new_scenes(number, start, begins, first, size):
    """A block of scenes, all of them in the same state."""
    centre, quaternion, linear, angular, floor = start
    n = len(number)
    scenes = Scenes(
        number, np.empty((size, n, 3), np.float32), np.empty((size, n, 4), np.float32),
        np.empty((size, n, 3), np.float32), np.empty((size, n, 3), np.float32), np.empty((size, 2), np.float32), floor,
    )  # fmt: skip
    for b in range(size):
        for k in range(n):
            for i in range(3):
                scenes.centre[b, k, i], scenes.linear[b, k, i] = centre[k, i], linear[k, i]
                scenes.angular[b, k, i] = angular[k, i]
            for i in range(4):
                scenes.quaternion[b, k, i] = quaternion[k, i]
        scenes.pusher[b, 0], scenes.pusher[b, 1] = begins[first + b, 0], begins[first + b, 1]
    return scenes


@numba.njit(**HELPER)
def _heading(scenes, b, x, y):
    """The direction of the pusher's velocity or, where it stands still, of the fastest object; as `motion.headings`."""
    speed = np.sqrt(x * x + y * y)
    if speed > _STANDS:
        return x / speed, y / speed
    fastest, x, y = ZERO, ONE, ZERO
    for n in range(len(scenes.number)):
        u, v = scenes.linear[b, n, 0], scenes.linear[b, n, 1]
        speed = np.sqrt(u * u + v * v)
        if speed > fastest:
            fastest, x, y = speed, u / speed, v / speed
    return (x, y) if fastest > _RESTS else (ONE, ZERO)


@numba.njit(**HELPER)
def _stop(scenes, b, contacts, scratch, x, y, places, frames, node) -> None:
    """Everything in a scene at rest, and what is needed to move the objects that take part afterwards.

    Args:
        x, y: the heading.
        places, frames: of each node: scene and slot; cosine and sine from the world to its frame, how it would slide.
        node: number of the first one.
    """
    for n in range(len(scenes.number)):
        for k in range(3):
            scenes.linear[b, n, k], scenes.angular[b, n, k] = ZERO, ZERO
        if contacts.awake[n]:
            places[node, 0], places[node, 1] = b, n
            u, v = scratch[n, 0], scratch[n, 1]
            frames[node, 0], frames[node, 1] = u * x - v * y, v * x + u * y
            frames[node, 2], frames[node, 3], frames[node, 4] = scratch[n, 3], scratch[n, 4], scratch[n, 5]
            node += 1


@numba.njit(**HELPER)
def _move(shapes, scenes, b, n, frames, node, motion, moved, rotation) -> None:
    """An object as the network and the sliding that it corrects tell; asleep if that is next to nothing."""
    at, x, y = node * MOTION_WIDTH, frames[node, 0], frames[node, 1]
    u, v, dz = (
        _SHIFT * (motion[at] + frames[node, 2]),
        _SHIFT * (motion[at + 1] + frames[node, 3]),
        _SHIFT * motion[at + 2],
    )
    dx, dy = x * u - y * v, y * u + x * v
    u, v, wz = _TURN * motion[at + 3], _TURN * motion[at + 4], _TURN * (motion[at + 5] + frames[node, 4])
    wx, wy = x * u - y * v, y * u + x * v
    angle = np.sqrt(wx * wx + wy * wy + wz * wz + _TINY)
    if np.sqrt(dx * dx + dy * dy + dz * dz) <= _SLEEP_M and angle <= _SLEEP_RAD:
        return
    moved[b, n] = True
    _turn(scenes.quaternion, b, n, wx, wy, wz, angle)
    scenes.centre[b, n, 0] += dx
    scenes.centre[b, n, 1] += dy
    lift = max(scenes.floor[n] - _lowest(shapes, scenes, b, n, scenes.centre[b, n, 2] + dz, rotation), ZERO)
    scenes.centre[b, n, 2] += dz + lift
    scenes.linear[b, n, 0], scenes.linear[b, n, 1], scenes.linear[b, n, 2] = dx, dy, dz + lift
    scenes.angular[b, n, 0], scenes.angular[b, n, 1], scenes.angular[b, n, 2] = wx, wy, wz


@numba.njit(**HELPER)
def _turn(quaternion, b, n, x, y, z, angle) -> None:
    """Turn an object by a rotation vector."""
    cosine, share = math.cos(HALF * angle), math.sin(HALF * angle) / angle
    x, y, z = share * x, share * y, share * z
    q = quaternion
    w, i, j, k = q[b, n, 0], q[b, n, 1], q[b, n, 2], q[b, n, 3]
    a = cosine * w - x * i - y * j - z * k
    c = cosine * i + w * x + y * k - z * j
    d = cosine * j + w * y + z * i - x * k
    e = cosine * k + w * z + x * j - y * i
    inverse = ONE / np.sqrt(a * a + c * c + d * d + e * e)
    q[b, n, 0], q[b, n, 1], q[b, n, 2], q[b, n, 3] = inverse * a, inverse * c, inverse * d, inverse * e


@numba.njit(**HELPER)
def _lowest(shapes, scenes, b, n, height, rotation):
    """Height of the lowest point of an object whose centre is at a height; as `motion.lowest_point`."""
    rotation_of(scenes.quaternion, b, n, rotation)
    least = ZERO
    for k in range(len(_DOWN_X)):
        _, _, z = farthest_point(shapes.support, scenes.number[n], rotation, n, _DOWN_X[k], _DOWN_Y[k], -ONE)
        least = min(least, z)
    return height + least


@numba.njit(**HELPER)
def _record(scenes, moved, first, action, centre, quaternion, has_moved) -> None:
    for b in range(len(moved)):
        for n in range(moved.shape[1]):
            has_moved[first + b, action, n] = moved[b, n]
            for k in range(3):
                centre[first + b, action, n, k] = scenes.centre[b, n, k]
            for k in range(4):
                quaternion[first + b, action, n, k] = scenes.quaternion[b, n, k]
