import contextlib
import json
from dataclasses import replace

import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from PIL import Image

from app.episodes import request as orders
from app.episodes.request import EpisodeOrder, read_goal
from osfcore.errors import CorruptFile, InvalidInput, MissingAssets, NoRoom, OsfError, UnknownName
from osfcore.experiments.estimation_tasks import SHIFT_M
from osfcore.fields.field_library import FieldLibrary
from osfcore.geometry.cameras import DEFAULT_IMAGE_SIDE, Camera, goal_camera
from osfcore.io.scene_file import camera_to_json
from osfcore.photo.table_layout import NoPhotographedTable
from osfcore.world import tasks
from osfcore.world.scenes import SceneRequest
from osfcore.world.tabletop import WORLDS, Tabletop
from tests.support.errors import about

NAMES = ("005_tomato_soup_can", "009_gelatin_box", "006_mustard_bottle")


@pytest.fixture
def order(data_dir, tmp_path):
    return EpisodeOrder(tmp_path / "out", data_dir, NAMES, seed=3)


@contextlib.contextmanager
def begun(order):
    begin = orders.given(order)
    with contextlib.closing(begin.world):
        yield begin


def same(one, other):
    return one.names == other.names and all(
        np.allclose(a, b, rtol=0, atol=1e-9)  # putting back a pose may round it
        for a, b in [
            (one.poses.position, other.poses.position),
            (one.poses.quaternion, other.poses.quaternion),
            (one.light.direction, other.light.direction),
        ]
    )


def test_a_seed_means_one_scene_and_one_goal(order):
    with begun(order) as one, begun(order) as again, begun(replace(order, seed=4)) as other:
        assert same(one.world.truth(), again.world.truth())
        assert same(one.truth, again.truth)
        assert one.moved == again.moved
        np.testing.assert_array_equal(one.goal.image, again.goal.image)
        assert not same(one.world.truth(), other.world.truth())
        assert not same(one.truth, other.truth)


@pytest.mark.parametrize("moved", [1, 2, 3])
def test_as_many_objects_as_asked_shall_lie_elsewhere_and_the_world_is_back_at_its_start(order, library, moved):
    plain = Tabletop(library, request=SceneRequest(names=NAMES))
    with contextlib.closing(plain), begun(replace(order, moved=moved)) as begin:
        plain.arrange(order.seed)
        start = begin.world.truth()
        assert same(start, plain.truth())
        np.testing.assert_allclose(start.pusher, plain.truth().pusher, atol=1e-12)
        shift = np.linalg.norm(begin.truth.poses.position - start.poses.position, axis=1)
        far = {name for name, distance in zip(start.names, shift, strict=True) if distance > 0.05}
        assert far == set(begin.moved)
        assert len(far) == moved
        assert shift.max() < SHIFT_M[1] + 0.01
        assert begin.truth.pusher is None


def test_the_goal_image_is_the_goal_without_a_pusher(order):
    with begun(order) as begin:
        begin.world.restore(begin.truth)
        seen = begin.world.render((goal_camera(),), with_pusher=False).images[0]
        np.testing.assert_array_equal(begin.goal.image, seen)
        assert begin.goal.camera.name == "goal"


def test_without_names_what_has_a_mesh_and_a_field_is_chosen(order):
    with begun(replace(order, names=None, objects=2)) as begin:
        assert len(set(begin.world.names)) == 2
        assert all(FieldLibrary(None).has(name) for name in begin.world.names)


def test_a_goal_from_a_file_leaves_the_truth_unknown(order, tmp_path):
    Image.new("RGB", (64, 64), (255, 0, 51)).save(tmp_path / "goal.png")
    with begun(replace(order, goal=tmp_path / "goal.png")) as begin:
        assert begin.truth is None
        assert begin.moved == ()
        np.testing.assert_allclose(begin.goal.image, np.broadcast_to([1, 0, 0.2], (64, 64, 3)), atol=1e-6)


@settings(max_examples=20, suppress_health_check=[HealthCheck.function_scoped_fixture])
@given(side=st.integers(16, 300), mode=st.sampled_from(["RGB", "RGBA", "L", "P"]))
def test_a_png_is_seen_by_the_goal_camera_at_its_size(tmp_path, side, mode):
    rng = np.random.default_rng(side)
    image = Image.fromarray(rng.integers(0, 256, (side, side, 3), np.uint8)).convert(mode)
    image.save(tmp_path / "goal.png")
    goal, camera = read_goal(tmp_path / "goal.png", goal_camera()), goal_camera()
    np.testing.assert_array_equal(np.round(goal.image * 255), np.asarray(image.convert("RGB")))
    assert (goal.camera.width, goal.camera.height) == (side, side)
    points = rng.uniform(-0.2, 0.2, (5, 3))
    scale = side / DEFAULT_IMAGE_SIDE
    np.testing.assert_allclose(goal.camera.project(points), camera.project(points) * scale, rtol=1e-9)


@pytest.mark.parametrize("size", [(64, 32), (64, 63), (8, 8), (1025, 1025)])
def test_a_size_that_the_camera_cannot_have_is_told(tmp_path, size):
    Image.new("RGB", size).save(tmp_path / "goal.png")
    with pytest.raises(InvalidInput, match=str(size[0])):
        read_goal(tmp_path / "goal.png", goal_camera())


@pytest.mark.parametrize("content", [None, b"", b"no image", "cut", "folder"])
def test_what_is_no_whole_png_is_told_in_one_sentence(tmp_path, content):
    path = tmp_path / "goal.png"
    if content == "folder":
        path.mkdir()
    elif content == "cut":
        Image.fromarray(np.random.default_rng(0).integers(0, 256, (64, 64, 3), np.uint8)).save(path)
        path.write_bytes(path.read_bytes()[:2000])
    elif content is not None:
        path.write_bytes(content)
    with pytest.raises(CorruptFile, check=about("goal.png")):
        read_goal(path, goal_camera())


@pytest.mark.parametrize(
    ("changes", "kind", "words"),
    [
        ({"names": ("teapot",)}, UnknownName, "'teapot'"),
        ({"names": ("002_master_chef_can",)}, MissingAssets, "002_master_chef_can"),
        ({"names": NAMES[:1] * 2}, InvalidInput, "without repetition"),
        ({"names": ()}, InvalidInput, "number of objects is 0"),
        ({"names": None, "objects": 6}, InvalidInput, "at most 5"),
        ({"moved": 0}, InvalidInput, "number of objects that move is 0, but it must be between 1 and 3"),
        ({"moved": 4}, InvalidInput, "number of objects that move is 4"),
    ],
)
def test_an_order_that_cannot_be_met_is_told_in_one_sentence(order, changes, kind, words):
    with pytest.raises(kind, match=words):
        orders.given(replace(order, **changes))


def test_where_no_goal_has_room_that_is_told(order, monkeypatch):
    monkeypatch.setattr(tasks, "draw_goal", lambda *_: None)
    with pytest.raises(NoRoom):
        orders.given(order)


@pytest.mark.parametrize("changes", [{"moved": 4}, {"goal": "nothing.png"}])
def test_a_refusal_leaves_no_simulation_behind(order, tmp_path, monkeypatch, changes):
    worlds = []

    class Counted(Tabletop):
        def __init__(self, *args, **more):
            super().__init__(*args, **more)
            worlds.append(self)

    monkeypatch.setitem(WORLDS, "simulated", lambda asked: Counted(asked.library, request=asked.request))
    if "goal" in changes:
        changes = {"goal": tmp_path / changes["goal"]}
    with pytest.raises((InvalidInput, CorruptFile)):
        orders.given(replace(order, **changes))
    (world,) = worlds
    with pytest.raises(OsfError, match="table is empty"):
        world.truth()


def found_file(order, place, table="board", apart_m=0.2, doubt=""):
    """What was found in a photograph of a box and a can that stand on a table somewhere else."""
    camera = Camera.look_at("photo", np.array([1.3, 2.0, 0.6]), np.array([1.0, 2.6, 0.0]))
    objects = [
        {"name": name, "position": [1.0 + shift, 2.6, height], "quaternion": [1.0, 0, 0, 0], "loss": 0.1, "iou": 0.95,
         "doubt": doubt, "rivals": []}
        for name, shift, height in (("009_gelatin_box", 0.0, 0.06), ("005_tomato_soup_can", apart_m, 0.051))
    ]  # fmt: skip
    path = place / "found.json"
    light = {"direction": [0.0, 0.6, 0.8], "std_deg": 1.0, "diffuse": False, "distance_m": None, "distance_std_m": None}
    facts = {"table": table, "objects": objects, "light": light, "camera": camera_to_json(camera), "notes": []}
    path.write_text(json.dumps(facts))
    return replace(order, names=None, found=path)


def test_what_was_found_in_a_photo_is_the_goal_and_objects_begin_elsewhere_on_the_same_side(order, tmp_path):
    with begun(replace(found_file(order, tmp_path), moved=2)) as begin:
        start, goal = begin.world.truth(), begin.goal
        assert set(begin.moved) == {"009_gelatin_box", "005_tomato_soup_can"}
        apart = goal.pose("005_tomato_soup_can").position - goal.pose("009_gelatin_box").position
        assert np.linalg.norm(apart[:2]) == pytest.approx(0.2, abs=0.02)
        np.testing.assert_allclose(goal.poses.position[:, :2].mean(axis=0), 0, atol=0.02)
        assert start.light.direction[2] == pytest.approx(0.8, abs=1e-6)
        for name in start.names:
            assert np.linalg.norm((start.pose(name).position - goal.pose(name).position)[:2]) > 0.05
            assert start.pose(name).position[2] == pytest.approx(goal.pose(name).position[2], abs=0.005)


def test_a_photo_that_tells_no_table_or_a_layout_too_wide_is_no_goal(order, tmp_path):
    with pytest.raises(NoPhotographedTable):
        orders.given(found_file(order, tmp_path, table=None))
    with pytest.raises(InvalidInput):
        orders.given(found_file(order, tmp_path, apart_m=0.6))
    for more in ({"goal": tmp_path / "goal.png"}, {"names": NAMES}):
        with pytest.raises(InvalidInput):
            orders.given(replace(found_file(order, tmp_path), **more))


def test_doubtful_objects_of_a_photo_are_taken_only_if_that_is_said(order, tmp_path):
    doubtful = found_file(order, tmp_path, doubt="It looks the same upside down.")
    with pytest.raises(OsfError, match="the same upside down"):
        orders.given(doubtful)
    with begun(replace(doubtful, settings=replace(doubtful.settings, despite_doubts=True))) as begin:
        assert len(begin.goal.names) == 2
