"""What only compiled code does: run on several threads and from several threads, with arrays of fixed size."""

import os
import subprocess
import sys
import threading

import numpy as np
import pytest

from osfcore.geometry.cameras import goal_camera
from osfcore.geometry.light import Light
from osfcore.render.kernels import MOST_OBJECTS as ROOM
from osfcore.render.renderer import SceneRenderer
from osfcore.render.types import MOST_OBJECTS, OUTPUTS, Quality, SceneBatch
from tests.support.rendered_scenes import plain_table, random_scene, state, view, wooden_table


def test_threads_that_render_at_once_do_not_disturb_each_other():
    fields, scene = random_scene(4)
    shared, batch = SceneRenderer(fields, wooden_table()), SceneBatch.of(scene)
    jobs = [(shared, (0.5, 0, 0.4)), (shared, (0, 0.5, 0.3)), (SceneRenderer(fields, None), (0.3, 0.3, 0.3))]
    expected = [r.render(batch, [view(p, size=16)], outputs=OUTPUTS) for r, p in jobs]
    wrong, start = [], threading.Barrier(6)

    def work(number: int) -> None:
        renderer, place = jobs[number]
        start.wait()
        for _ in range(8):
            found = renderer.render(batch, [view(place, size=16)], outputs=OUTPUTS)
            if not all(np.array_equal(getattr(found, n), getattr(expected[number], n)) for n in ("rgb", "depth")):
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
from tests.support.rendered_scenes import ball, plain_table, state, view

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
images = []
for count in (1, 2):
    numba.set_num_threads(count)
    images.append(renderer.render(batch, [view()]).rgb)
np.testing.assert_array_equal(*images)
print(numba.threading_layer())
"""


@pytest.mark.slow
@pytest.mark.parametrize("layer", ["workqueue", "default"])
def test_no_threading_layer_ends_the_process_when_threads_meet(layer):
    """Numba's own layer, which machines without OpenMP get, aborts when two calls overlap.

    Nor does the number of threads change an image.
    """
    env = os.environ | {"NUMBA_THREADING_LAYER": layer, "NUMBA_NUM_THREADS": "2", "OMP_NUM_THREADS": "1"}
    done = subprocess.run([sys.executable, "-c", _CROWD], env=env, capture_output=True, text=True, timeout=300)
    assert done.returncode == 0, done.stderr[-2000:]
    if layer == "workqueue":
        assert done.stdout.split() == ["workqueue"]


def test_there_is_room_for_all_objects_and_the_pusher():
    assert MOST_OBJECTS + 1 <= ROOM


def test_several_rays_a_pixel_change_only_the_edge_of_an_empty_table():
    batch, camera = SceneBatch.of(state({}, Light(np.array([0.0, 0, 1])).position)), goal_camera(64)
    renderer = SceneRenderer({}, plain_table())
    one, many = (renderer.render(batch, (camera,), quality=Quality(samples_per_side=n)).rgb[0, 0] for n in (1, 4))
    changed = np.abs(one - many).max(axis=-1) > 1e-5
    assert 0 < changed.sum() < 0.1 * changed.size
