"""Compiled rays from pixels to the table, and the table where nothing stands on it."""
# ruff: noqa: ANN001, ANN201, D417 - compiled helpers; types are given by their callers

from __future__ import annotations

import numba
import numpy as np

from osfcore.render.lamp_kernels import light_on_table
from osfcore.render.numba_options import FAR, HELPER, TINY


@numba.njit(**HELPER)
def pixel_ray(cameras, view, u, v):
    """Unit direction in the world through a place of the image, and 1 / the length it had.

    Args:
        cameras, view: V x 12 numbers of `types.camera_numbers`, and which camera.
        u, v: the place [px], columns and rows.
    """
    x = cameras[view, 3] * u + cameras[view, 4] * v + cameras[view, 5]
    y = cameras[view, 6] * u + cameras[view, 7] * v + cameras[view, 8]
    z = cameras[view, 9] * u + cameras[view, 10] * v + cameras[view, 11]
    inverse = _ONE / np.sqrt(x * x + y * y + z * z)
    return x * inverse, y * inverse, z * inverse, inverse


@numba.njit(**HELPER)
def meet_table(table, cameras, view, dx, dy, dz):
    """Distance along a camera's ray to the table [m]; `FAR` if it misses.

    Args:
        table: `launch.Table`.
        cameras, view: as in `pixel_ray`.
        dx, dy, dz: unit direction in the world.
    """
    if table.exists and dz < -TINY and cameras[view, 2] > _ZERO:
        t = -cameras[view, 2] / dz
        x, y = cameras[view, 0] + t * dx, cameras[view, 1] + t * dy
        if abs(x) <= table.half_side and abs(y) <= table.half_side:
            return t
    return FAR


@numba.njit(**HELPER)
def table_colour(table, directs, lamps, b, x, y, visible):
    """Radiance of the table at a point of it.

    Args:
        table: `launch.Table`.
        directs, lamps, b: direct light of distant lights on a white table (a row for each), lamps, and which row.
        x, y: the point in the world [m].
        visible: transmittance from there toward the light.
    """
    g = len(table.albedo)
    u = (x / table.half_side + _ONE) * _HALF * np.float32(g - 1)
    v = (y / table.half_side + _ONE) * _HALF * np.float32(g - 1)
    i, j = min(max(int(u), 0), g - 2), min(max(int(v), 0), g - 2)
    fu, fv = u - np.float32(i), v - np.float32(j)
    w00, w01, w10, w11 = (_ONE - fu) * (_ONE - fv), (_ONE - fu) * fv, fu * (_ONE - fv), fu * fv
    al = table.albedo
    r = al[i, j, 0] * w00 + al[i, j + 1, 0] * w01 + al[i + 1, j, 0] * w10 + al[i + 1, j + 1, 0] * w11
    g_ = al[i, j, 1] * w00 + al[i, j + 1, 1] * w01 + al[i + 1, j, 1] * w10 + al[i + 1, j + 1, 1] * w11
    b_ = al[i, j, 2] * w00 + al[i, j + 1, 2] * w01 + al[i + 1, j, 2] * w10 + al[i + 1, j + 1, 2] * w11
    if lamps is None:
        return (
            r * (table.ambient[0] + directs[b, 0] * visible),
            g_ * (table.ambient[1] + directs[b, 1] * visible),
            b_ * (table.ambient[2] + directs[b, 2] * visible),
        )
    red, green, blue = light_on_table(lamps, b, x, y)
    return (
        r * (table.ambient[0] + red * visible),
        g_ * (table.ambient[1] + green * visible),
        b_ * (table.ambient[2] + blue * visible),
    )


@numba.njit(**HELPER)
def empty_pixel(table, cameras, directs, lamps, b, view, row, column, samples):
    """Colour of a pixel of the empty, unshaded table, and its distance [m], 0 where there is no table.

    Args:
        table: `launch.Table`.
        cameras, directs, lamps, b: as in `table_colour`.
        view, row, column: the pixel.
        samples: rays along each side of a pixel that straddles the table's edge; elsewhere one ray is exact enough,
            except for the edge of a lamp's cone.
    """
    hits = 0
    for s in range(4 if samples > 1 else 0):  # a pixel that straddles the table's edge shows a part of it
        u, v = np.float32(column + s % 2), np.float32(row + s // 2)
        dx, dy, dz, _ = pixel_ray(cameras, view, u, v)
        hits += meet_table(table, cameras, view, dx, dy, dz) < FAR
    count = samples if 0 < hits < 4 or lamps is not None else 1
    share = _ONE / np.float32(count * count)
    red = green = blue = reach = _ZERO
    hits = 0
    for s in range(count * count):
        u = np.float32(column + (s % count + 0.5) / count)
        v = np.float32(row + (s // count + 0.5) / count)
        dx, dy, dz, _ = pixel_ray(cameras, view, u, v)
        t = meet_table(table, cameras, view, dx, dy, dz)
        if t < FAR:
            x, y = cameras[view, 0] + t * dx, cameras[view, 1] + t * dy
            r, g, bl = table_colour(table, directs, lamps, b, x, y, _ONE)
            hits, reach = hits + 1, reach + t
        else:
            r, g, bl = table.background[0], table.background[1], table.background[2]
        red, green, blue = red + share * r, green + share * g, blue + share * bl
    return red, green, blue, reach / np.float32(max(hits, 1))
