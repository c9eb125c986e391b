"""Kernels: kernels, table kernels."""

import os
import subprocess
import sys
import threading

import numba
import numpy as np
import pytest

from osfcore.geometry.cameras import goal_camera
from osfcore.geometry.light import Light
from osfcore.render.kernels import MOST_OBJECTS as ROOM
from osfcore.render.renderer import SceneRenderer
from osfcore.render.types import EXACT, MOST_OBJECTS, OUTPUTS, PLANNING, Quality, SceneBatch
from tests.core.render.scenes import plain_table, random_scene, view, wooden_table

# What only the compiled code does: run on several threads, from several threads, with arrays of fixed size.


def test_there_is_room_for_every_object_and_the_pusher():
    assert MOST_OBJECTS + 1 <= ROOM


def test_threads_that_render_at_once_do_not_disturb_each_other():
    fields, scene = random_scene(4)
    shared, batch = SceneRenderer(fields, wooden_table()), SceneBatch.of(scene)
    jobs = [(shared, (0.5, 0, 0.4)), (shared, (0, 0.5, 0.3)), (SceneRenderer(fields, None), (0.3, 0.3, 0.3))]
    expected = [r.render(batch, [view(p)], outputs=OUTPUTS) for r, p in jobs]
    wrong, start = [], threading.Barrier(6)

    def work(number: int) -> None:
        renderer, place = jobs[number]
        start.wait()
        for _ in range(8):
            found = renderer.render(batch, [view(place)], outputs=OUTPUTS)
            if not (
                np.array_equal(found.rgb, expected[number].rgb) and np.array_equal(found.depth, expected[number].depth)
            ):
                wrong.append(number)

    threads = [threading.Thread(target=work, args=(n % 3,)) for n in range(6)]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    assert wrong == []


_CROWD = """
import threading
import numba
import numpy as np
from osfcore.fields.rays import march
from osfcore.render.renderer import SceneBatch, SceneRenderer
from tests.core.render.scenes import ball, plain_table, state, view

renderer, batch = SceneRenderer({"ball": ball()}, plain_table()), SceneBatch.of(state({"ball": (0, 0, 0.05)}))
rays = np.tile(np.float32([0, 0, 1]), (20_000, 1))

def draw():
    for _ in range(30):
        renderer.render(batch, [view()])

def walk():
    for _ in range(30):
        march(ball(), rays, -rays, step=0.001)

threads = [threading.Thread(target=f) for f in (draw, walk, draw, walk)]
[t.start() for t in threads]
[t.join() for t in threads]
print(numba.threading_layer())
"""


@pytest.mark.slow
@pytest.mark.parametrize("layer", ["workqueue", "default"])
def test_no_threading_layer_ends_the_process_when_threads_meet(layer):
    """Numba's own layer, which machines without OpenMP get, aborts when two calls overlap."""
    env = os.environ | {"NUMBA_THREADING_LAYER": layer, "NUMBA_NUM_THREADS": "2", "OMP_NUM_THREADS": "1"}
    done = subprocess.run([sys.executable, "-c", _CROWD], env=env, capture_output=True, text=True, timeout=300)
    assert done.returncode == 0, done.stderr[-2000:]
    if layer == "workqueue":
        assert done.stdout.split() == ["workqueue"]


@pytest.mark.parametrize("threads", [1, 2])
def test_the_number_of_threads_changes_nothing(threads):
    fields, scene = random_scene(2)
    renderer = SceneRenderer(fields, wooden_table())
    expected = renderer.render(SceneBatch.of(scene), [view()], quality=PLANNING).rgb
    before = numba.get_num_threads()
    if threads > numba.config.NUMBA_NUM_THREADS:
        pytest.skip("this process has one thread")
    numba.set_num_threads(threads)
    try:
        np.testing.assert_array_equal(renderer.render(SceneBatch.of(scene), [view()], quality=PLANNING).rgb, expected)
    finally:
        numba.set_num_threads(before)


# The empty table from compiled code.


NOTHING = np.zeros((1, 0, 3)), np.zeros((1, 0, 4))


def bare(table, light, camera, quality=EXACT):
    batch = SceneBatch((), *NOTHING, light.direction[None], None)
    return SceneRenderer({}, table).render(batch, (camera,), quality=quality, outputs={"rgb", "depth"})


def test_the_bare_table_is_its_albedo_under_the_light():
    table, camera = plain_table(), goal_camera(32)
    light = Light(np.array([0.3, 0.2, 0.8]))
    image = bare(table, light, camera).rgb[0, 0]
    expected = table.albedo[0, 0] * (table.ambient + table.direct(light.direction[None])[0])
    np.testing.assert_allclose(image[16, 16], expected, atol=1e-5)


def test_depth_is_that_of_the_plane():
    camera = goal_camera(32)
    depth = bare(plain_table(), Light(np.array([0.0, 0, 1])), camera).depth[0, 0]
    pixels = np.array([[16.5, 20.5]])
    ray = camera.ray_directions(pixels)[0]
    distance = -camera.T_world_camera.position[2] / ray[2]
    axis = camera.T_world_camera.matrix()[:3, 2]
    np.testing.assert_allclose(depth[20, 16], distance * (ray @ axis), rtol=1e-5)


def test_several_rays_a_pixel_change_only_the_tables_edge():
    light, camera = Light(np.array([0.0, 0, 1])), goal_camera(64)
    one = bare(plain_table(), light, camera).rgb[0, 0]
    many = bare(plain_table(), light, camera, Quality(samples_per_side=4)).rgb[0, 0]
    changed = np.abs(one - many).max(axis=-1) > 1e-5
    assert 0 < changed.sum() < 0.1 * changed.size
