"""Our own scene, written as BOP does, is read as it was; results are what BOP's toolkit reads."""

import json

import numpy as np
import pytest

from osfcore.errors import CorruptFile, InvalidInput, UnknownName
from osfcore.estimation.objective import resting_orientations
from osfcore.fields.field_library import FieldLibrary
from osfcore.geometry.cameras import default_cameras
from osfcore.geometry.poses import Pose, quaternion_to_matrix, rotation_angle
from osfcore.geometry.states import EstimatedState, Observation
from osfcore.io.observation_file import read_observation, write_observation
from osfcore.photo.bop import BopChoice, PoseChoice, bop_results, read_bop_scene, read_poses
from osfcore.photo.pose_loss import TablePrior
from osfcore.world.scenes import SceneRequest
from osfcore.world.tabletop import Tabletop
from tests.core.photo.other_programs.bop_scenes import annotation, write_bop_scene, write_models_info

NAMES = ("003_cracker_box", "006_mustard_bottle")
LINEAR = BopChoice(encoding="linear")
CENTRES = {"003_cracker_box": (0.01, -0.02, 0.03), "006_mustard_bottle": (-0.015, 0.0, 0.002)}


@pytest.fixture(scope="module")
def rendered(library):
    """Observation and true state of a simulated scene."""
    cameras = default_cameras(64)
    world = Tabletop(library, cameras=cameras, request=SceneRequest(NAMES, 2))
    try:
        world.arrange(3)
        return world.render(cameras, masks=True, with_pusher=False), world.truth()
    finally:
        world.close()


@pytest.fixture
def folder(rendered, tmp_path):
    return write_bop_scene(tmp_path / "000048", *rendered)


def same(a: Pose, b: Pose, *, mm=1e-3, rad=1e-5):
    return np.abs(a.position - b.position).max() < 1e-3 * mm and rotation_angle(a.quaternion, b.quaternion) < rad


def edit(path, change):
    content = json.loads(path.read_text())
    change(content)
    path.write_text(json.dumps(content))


def test_what_was_written_is_read(folder, rendered, tmp_path):
    observation, state = rendered
    scene = read_bop_scene(folder, LINEAR)
    read = scene.observation
    assert [camera.name for camera in read.cameras] == ["3", "6", "9", "12"]
    assert read.names == NAMES
    for ours, theirs in zip(observation.cameras, read.cameras, strict=True):
        assert same(ours.T_world_camera, theirs.T_world_camera)
        np.testing.assert_allclose(theirs.intrinsics, ours.intrinsics, atol=1e-9)
    for name in NAMES:
        assert same(scene.poses[name], state.pose(name))
        ours, theirs = (o.masks[:, o.names.index(name)] for o in (observation, read))
        np.testing.assert_array_equal(theirs, ours)
    np.testing.assert_allclose(read.images, observation.images, atol=0.6 / 255)
    write_observation(tmp_path / "observation", read)
    assert read_observation(tmp_path / "observation").names == NAMES


def test_origins_of_models_are_those_of_models_info(rendered, tmp_path):
    folder = write_bop_scene(tmp_path / "000001", *rendered, centres=CENTRES)
    models = write_models_info(tmp_path / "models", CENTRES)
    told = read_bop_scene(folder, BopChoice(encoding="linear", models=models))
    assumed = read_bop_scene(folder, LINEAR)
    for name, centre in CENTRES.items():
        assert same(told.poses[name], rendered[1].pose(name))
        off = np.linalg.norm(assumed.poses[name].position - told.poses[name].position)
        assert off == pytest.approx(np.linalg.norm(centre), abs=1e-6)
    with pytest.raises(CorruptFile, match=r"models_info\.json"):
        read_bop_scene(folder, BopChoice(models=tmp_path))


@pytest.mark.parametrize("centres", [None, CENTRES])
def test_results_are_read_by_the_rules_of_the_toolkit(rendered, tmp_path, centres):
    observation, state = rendered
    folder = write_bop_scene(tmp_path / "000048", *rendered, centres=centres)
    models = None if centres is None else write_models_info(tmp_path / "models", centres)
    scene = read_bop_scene(folder, BopChoice(encoding="linear", models=models))
    deviations = np.array([0.0, 0.001]), np.zeros(2)
    estimate = EstimatedState(state.reordered(NAMES), *deviations, 0.0, ("", ""), "")
    text = bop_results(estimate, scene.observation.cameras, 48, models, 2.5)
    header, *lines = text.splitlines()
    assert header == "scene_id,im_id,obj_id,score,R,t,time"
    annotations = json.loads((folder / "scene_gt.json").read_text())
    assert len(lines) == len(annotations) * len(NAMES)
    for line in lines:
        scene_id, im_id, obj_id, score, R, t, seconds = line.split(",")  # as bop_toolkit_lib.inout.load_bop_results
        (truth,) = (e for e in annotations[im_id] if e["obj_id"] == int(obj_id))
        np.testing.assert_allclose(np.array(list(map(float, R.split()))), truth["cam_R_m2c"], atol=1e-6)
        np.testing.assert_allclose(np.array(list(map(float, t.split()))), truth["cam_t_m2c"], atol=1e-3)
        assert (int(scene_id), float(seconds)) == (48, 2.5)
        assert float(score) == {2: 1.0, 5: 0.5}[int(obj_id)]
    if centres is None:
        (tmp_path / "results.csv").write_text(text)
        poses = read_poses(tmp_path / "results.csv", PoseChoice(image=6))
        T_camera_world = observation.cameras[1].T_world_camera.inverse()
        assert all(same(poses[name], T_camera_world @ state.pose(name)) for name in NAMES)


def test_results_need_numbers_of_images_and_objects(rendered):
    observation, state = rendered
    zeros = np.zeros(2)
    estimate = EstimatedState(state, zeros, zeros, 0.0, ("", ""), "")
    goal = default_cameras(64)[0]
    named = type(goal)("goal", goal.T_world_camera, goal.intrinsics, 64, 64)
    with pytest.raises(InvalidInput, match="name of a camera is goal, but it must be the number of its image"):
        bop_results(estimate, (named,), 1)
    with pytest.raises(InvalidInput, match="number of the scene is -1"):
        bop_results(estimate, observation.cameras, -1)
    pear = type(state)(("016_pear",), Pose.identity(1), state.light, None)
    with pytest.raises(UnknownName, match="016_pear"):
        bop_results(EstimatedState(pear, zeros[:1], zeros[:1], 0.0, ("",), ""), observation.cameras, 1)


def test_a_table_is_found_under_the_objects_of_any_world(folder, rendered):
    def tilt(content):  # the world of the first camera
        first = {k: np.array(content["3"][k]) for k in ("cam_R_w2c", "cam_t_w2c")}
        R0, t0 = first["cam_R_w2c"].reshape(3, 3), first["cam_t_w2c"]
        for entry in content.values():
            R = np.array(entry["cam_R_w2c"]).reshape(3, 3) @ R0.T
            entry["cam_t_w2c"] = (np.array(entry["cam_t_w2c"]) - R @ t0).tolist()
            entry["cam_R_w2c"] = R.ravel().tolist()

    edit(folder / "scene_camera.json", tilt)
    with pytest.raises(InvalidInput, match="height of image 3.* above a table at z = 0.*--table objects"):
        read_bop_scene(folder, LINEAR)
    fields = FieldLibrary(None)

    def prior(name):
        return TablePrior(resting_orientations(fields.load(name)))

    scene = read_bop_scene(folder, LINEAR, table_prior=prior)
    cameras = scene.observation.cameras
    for k, name in enumerate(NAMES):
        np.testing.assert_allclose(scene.poses[name].position[2], rendered[1].pose(name).position[2], atol=4e-3)
        upright = quaternion_to_matrix(scene.poses[name].quaternion)[2]
        np.testing.assert_allclose(upright, quaternion_to_matrix(rendered[1].pose(name).quaternion)[2], atol=0.1)
        for view, camera in enumerate(cameras):
            place = camera.project(scene.poses[name].position)
            expected = rendered[0].cameras[view].project(rendered[1].pose(name).position)
            np.testing.assert_allclose(place, expected, atol=1e-2, err_msg=f"{k} {view}")


def test_the_table_is_found_without_objects_that_nobody_knows(folder, rendered):
    fields = FieldLibrary(None)
    observation, state = rendered
    number = 18  # the marker, of which there is no field

    def add_marker(content):
        for entries, camera in zip(content.values(), observation.cameras, strict=True):
            floating = camera.T_world_camera.inverse() @ Pose(np.array([0.0, 0, 0.3]), state.poses.quaternion[0])
            entries.append(annotation(floating, number))

    edit(folder / "scene_gt.json", add_marker)
    scene = read_bop_scene(
        folder,
        LINEAR,
        table_prior=lambda name: TablePrior(resting_orientations(fields.load(name))),
        known=fields.names(),
    )
    assert (scene.observation.names, scene.left_out) == (NAMES, ("040_large_marker",))
    edit(folder / "scene_camera.json", without_places)
    with pytest.raises(InvalidInput, match="given for several images; choose one with --images"):
        read_bop_scene(folder, LINEAR, table_prior=lambda name: TablePrior(resting_orientations(fields.load(name))))


def without_places(content):
    for entry in content.values():
        del entry["cam_R_w2c"], entry["cam_t_w2c"]


def in_metres(content):
    for entry in content.values():
        entry["cam_t_w2c"] = (np.array(entry["cam_t_w2c"]) / 1e3).tolist()


@pytest.mark.parametrize(
    ("file", "change", "sentence"),
    [
        ("scene_camera.json", without_places, "cam_R_w2c and cam_t_w2c of image 3 is missing.*--table objects"),
        (
            "scene_camera.json",
            in_metres,
            "image 3's camera in BOP's world .* seems to mean another world or unit than mm",
        ),
        ("scene_camera.json", lambda c: c["3"].pop("cam_K"), "cam_K"),
        ("scene_camera.json", lambda c: c.clear(), "at least one"),
        ("scene_camera.json", lambda c: c["3"]["cam_R_w2c"].__setitem__(0, 3.0), "a rotation matrix, row by row"),
        ("scene_gt.json", lambda c: c["3"].append(c["3"][0]), "several times"),
        ("scene_gt.json", lambda c: c["3"][0].update(obj_id=30), "number of the object is 30"),
    ],
)
def test_mistakes_are_told(folder, file, change, sentence):
    edit(folder / file, change)
    with pytest.raises((InvalidInput, CorruptFile), match=sentence):
        read_bop_scene(folder, LINEAR)


def test_what_is_chosen_must_be_there(folder):
    chosen = read_bop_scene(folder, BopChoice((9,), "linear"), NAMES[1:]).observation
    assert isinstance(chosen, Observation)
    assert ([camera.name for camera in chosen.cameras], chosen.names) == (["9"], NAMES[1:])
    with pytest.raises(InvalidInput, match="image is 4, but it must be one of 3, 6, 9, 12"):
        read_bop_scene(folder, BopChoice((4,)))
    with pytest.raises(InvalidInput, match="object is 025_mug, but it must be one that"):
        read_bop_scene(folder, LINEAR, ("025_mug",))
    known = read_bop_scene(folder, LINEAR, known=NAMES[:1])
    assert (known.observation.names, known.left_out) == (NAMES[:1], NAMES[1:])
    (folder / "rgb" / "000003.png").unlink()
    with pytest.raises(CorruptFile, match=r"rgb.000003\.png cannot be used"):
        read_bop_scene(folder)
    with pytest.raises(CorruptFile, match=r"scene_camera\.json"):
        read_bop_scene(folder / "rgb")
