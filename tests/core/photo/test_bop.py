"""Bop: bop scene, mask folder, pose file."""

import json

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.io import savemat

from osfcore.errors import CorruptFile, InvalidInput, UnknownName
from osfcore.estimation.objective import resting_orientations
from osfcore.fields.field_library import FieldLibrary
from osfcore.geometry.cameras import default_cameras
from osfcore.geometry.poses import Pose, quaternion_exp, quaternion_to_matrix, rotation_angle
from osfcore.geometry.states import EstimatedState, Observation
from osfcore.io.image_file import write_png
from osfcore.io.observation_file import read_observation, write_observation
from osfcore.photo.bop import NAMES as YCB_VIDEO_NAMES
from osfcore.photo.bop import (
    BopChoice,
    PoseChoice,
    bop_results,
    in_object_frame,
    name_of,
    read_bop_scene,
    read_masks,
    read_poses,
    scene_gt_names,
)
from osfcore.photo.pose_loss import TablePrior
from osfcore.world.scenes import SceneRequest
from osfcore.world.tabletop import Tabletop
from tests.core.photo.bop_scenes import annotation, write_bop_scene, write_models_info

# Our own scene, written as BOP does, is read as it was; results are what BOP's toolkit reads.


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


# Masks in folders: by name, and as BOP numbers them.


KNOWN = ("025_mug", "003_cracker_box", "009_gelatin_box")
SENT, KEPT = (80, 60), (40, 30)


def mask_at(left, value=255, size=SENT):
    image = np.zeros((size[1], size[0]), np.uint8)
    image[10:30, left : left + 20] = value
    return image


@pytest.mark.parametrize("name", ["025_mug.png", "mask_025_mug.png"])
@pytest.mark.parametrize("value", [1, 255])
def test_masks_by_name(tmp_path, name, value):
    write_png(tmp_path / name, mask_at(10, value))
    write_png(tmp_path / "photo.png", mask_at(0))
    (masks,) = (read_masks(tmp_path, KNOWN, (SENT, SENT)),)
    assert list(masks) == ["025_mug"]
    np.testing.assert_array_equal(masks["025_mug"], mask_at(10) > 0)


def test_masks_of_the_photo_as_it_was_sent_are_reduced_with_it(tmp_path):
    write_png(tmp_path / "025_mug.png", mask_at(10))
    mask = read_masks(tmp_path, KNOWN, (SENT, KEPT))["025_mug"]
    assert mask.shape == KEPT[::-1]
    assert mask[5:15, 5:15].all()
    assert mask.sum() == 100


@pytest.mark.parametrize("place", [".", ".."])
def test_masks_of_bop(tmp_path, place):
    folder = tmp_path / "mask_visib"
    for image, index, left in ((1, 0, 0), (1, 1, 20), (2, 0, 40)):
        write_png(folder / f"{image:06d}_{index:06d}.png", mask_at(left))
    entry = {"cam_R_m2c": [1, 0, 0, 0, 1, 0, 0, 0, 1], "cam_t_m2c": [0, 0, 900.0]}
    with pytest.raises(InvalidInput, match="scene_gt.json of the masks is missing"):
        read_masks(folder, KNOWN, (SENT, SENT), 1)
    content = {"1": [{**entry, "obj_id": 14}, {**entry, "obj_id": 2}], "2": [{**entry, "obj_id": 8}]}
    (folder / place / "scene_gt.json").write_text(json.dumps(content))
    masks = read_masks(folder, KNOWN, (SENT, SENT), 1)
    assert list(masks) == ["025_mug", "003_cracker_box"]
    assert masks["003_cracker_box"][20, 30]
    assert list(read_masks(folder, KNOWN, (SENT, SENT), 2)) == ["009_gelatin_box"]
    with pytest.raises(InvalidInput, match="image of the masks is not told, but it must be one of 1, 2"):
        read_masks(folder, KNOWN, (SENT, SENT))


def test_mistakes_are_told_mask_folder(tmp_path):
    with pytest.raises(InvalidInput, match="a folder that exists"):
        read_masks(tmp_path / "none", KNOWN, (SENT, SENT))
    with pytest.raises(InvalidInput, match="number of masks of known objects in the folder is 0"):
        read_masks(tmp_path, KNOWN, (SENT, SENT))
    write_png(tmp_path / "025_mug.png", mask_at(0, 0))
    with pytest.raises(InvalidInput, match="number of masks of known objects in the folder is 0"):
        read_masks(tmp_path, KNOWN, (SENT, SENT))
    write_png(tmp_path / "025_mug.png", mask_at(10, size=(64, 48)))
    with pytest.raises(InvalidInput, match="is 64 x 48 pixels, but it must be the photo's, 80 x 60 pixels"):
        read_masks(tmp_path, KNOWN, (SENT, SENT))
    (tmp_path / "025_mug.png").write_text("no picture")
    with pytest.raises(CorruptFile, match="it is no picture"):
        read_masks(tmp_path, KNOWN, (SENT, SENT))


# Poses of other programs: what is written is read, in the frame of the box's centre.


HEADER = "scene_id,im_id,obj_id,score,R,t,time"
POSE = Pose(np.array([0.05, -0.1, 0.8]), quaternion_exp(np.array([0.4, -1.2, 0.3])))


def numbers(values):
    return " ".join(repr(float(v)) for v in np.ravel(values))


def bop_line(pose=POSE, obj=14, scene=48, image=1, score=1.0):
    return f"{scene},{image},{obj},{score},{numbers(pose_matrix(pose))},{numbers(1e3 * pose.position)},-1"


def pose_matrix(pose):
    return quaternion_to_matrix(pose.quaternion)


def bop_entry(pose=POSE, obj=14):
    shift = (1e3 * pose.position).tolist()
    return {"cam_R_m2c": pose_matrix(pose).ravel().tolist(), "cam_t_m2c": shift, "obj_id": obj}


def same_pose(a, b):
    return np.abs(a.position - b.position).max() < 1e-6 and rotation_angle(a.quaternion, b.quaternion) < 1e-5


def write(folder, name, content):
    path = folder / name
    path.write_text(content if isinstance(content, str) else json.dumps(content))
    return path


@given(
    turn=st.lists(st.floats(-1.8, 1.8), min_size=3, max_size=3),
    position=st.tuples(st.floats(-0.5, 0.5), st.floats(-0.5, 0.5), st.floats(0.1, 3.0)),
    obj=st.integers(1, 21),
)
@settings(max_examples=30, deadline=None)
def test_poses_survive_every_form(tmp_path_factory, turn, position, obj):
    folder = tmp_path_factory.mktemp("poses")
    pose, name = Pose(np.array(position), quaternion_exp(np.array(turn))), name_of(obj)
    entry = {"position": pose.position.tolist(), "quaternion": pose.quaternion.tolist()}
    written = [
        write(folder, "bop.csv", f"{HEADER}\n{bop_line(pose, obj)}\n"),
        write(folder, "bare.csv", bop_line(pose, obj)),
        write(folder, "scene_gt.json", {"3": [bop_entry(pose, obj)]}),
        write(folder, "plain.json", {name: entry}),
        write(folder, "photo.json", {"poses_camera_object": {"mine": {name: entry}}, "image": "photo.png"}),
    ]
    for path in written:
        (found,) = read_poses(path).items()
        assert found[0] == name
        assert same_pose(found[1], pose)
    rois, values = np.array([[0, obj, 1, 2, 3, 4]]), np.concatenate([pose.quaternion, pose.position])[None]
    savemat(folder / "000001.mat", {"rois": rois, "poses": values, "poses_icp": values})
    found = read_poses(folder / "000001.mat", PoseChoice(source="poses_icp"))
    assert same_pose(found[name], in_object_frame(pose, name, "ycb_video"))


def test_numbers_are_those_of_ycb_video():
    assert (name_of(1), name_of(14), name_of(21)) == ("002_master_chef_can", "025_mug", "061_foam_brick")
    assert len(set(YCB_VIDEO_NAMES)) == 21
    with pytest.raises(InvalidInput, match="1 to 21"):
        name_of(22)


@pytest.mark.parametrize("frame", ["ycb_video", "google_16k"])
@pytest.mark.parametrize("name", ["025_mug", "061_foam_brick"])
def test_frames_differ_by_a_shift_that_turns_with_the_object(name, frame):
    still = in_object_frame(Pose.identity(), name, frame)
    turned = in_object_frame(POSE, name, frame)
    assert same_pose(turned, POSE @ still)
    assert 0 < np.linalg.norm(still.position) < 0.15
    assert same_pose(in_object_frame(POSE, name, "bop"), POSE)


def test_the_frame_is_that_of_the_kind_of_file_unless_told(tmp_path):
    path = write(tmp_path, "bop.csv", bop_line())
    told = read_poses(path, PoseChoice(frame="ycb_video"))["025_mug"]
    assert same_pose(told, in_object_frame(POSE, "025_mug", "ycb_video"))


def test_an_origin_that_is_not_known_is_told(tmp_path):
    path = write(tmp_path, "bop.csv", bop_line(obj=17))
    assert "037_scissors" in read_poses(path)
    with pytest.raises(UnknownName, match="google_16k named '037_scissors'"):
        read_poses(path, PoseChoice(frame="google_16k"))


def test_the_best_score_counts(tmp_path):
    other = Pose(POSE.position + 0.1, POSE.quaternion)
    lines = [bop_line(other, score=0.2), bop_line(score=0.9), bop_line(other, score=0.5)]
    assert same_pose(read_poses(write(tmp_path, "bop.csv", "\n".join(lines)))["025_mug"], POSE)


def test_rows_of_posecnn_without_a_pose_are_left_out(tmp_path):
    poses = np.stack([np.zeros(7), np.concatenate([POSE.quaternion, POSE.position])])
    savemat(tmp_path / "a.mat", {"rois": np.array([[0, 1, 0, 0, 9, 9, 0.9], [0, 14, 0, 0, 9, 9, 0.8]]), "poses": poses})
    assert list(read_poses(tmp_path / "a.mat")) == ["025_mug"]


def test_images_and_scenes_are_chosen(tmp_path):
    lines = [HEADER, bop_line(), bop_line(obj=1, image=36), bop_line(obj=2, scene=50)]
    path = write(tmp_path, "bop.csv", "\n".join(lines))
    with pytest.raises(InvalidInput, match="scene of the poses is not told, but it must be one of 48, 50"):
        read_poses(path)
    with pytest.raises(InvalidInput, match="image of the poses is 7, but it must be one of 1, 36"):
        read_poses(path, PoseChoice(7, 48))
    assert list(read_poses(path, PoseChoice(36, 48))) == ["002_master_chef_can"]
    gt = write(tmp_path, "scene_gt.json", {"1": [bop_entry()], "36": [bop_entry(obj=5), bop_entry(obj=2)]})
    assert list(read_poses(gt, PoseChoice(1))) == ["025_mug"]
    assert scene_gt_names(gt, 36) == ("006_mustard_bottle", "003_cracker_box")


def test_a_source_is_chosen(tmp_path):
    entry = {"025_mug": {"position": [0, 0, 1], "quaternion": [1, 0, 0, 0]}}
    path = write(tmp_path, "photo.json", {"poses_camera_object": {"posecnn_raw": entry, "truth": entry}})
    with pytest.raises(CorruptFile, match="source of the poses is not told, but it must be one of posecnn_raw, truth"):
        read_poses(path)
    assert list(read_poses(path, PoseChoice(source="truth"))) == ["025_mug"]


@pytest.mark.parametrize(
    ("name", "content", "sentence"),
    [
        ("a.txt", "", "poses come in"),
        ("a.csv", "", "it holds no poses"),
        ("a.csv", HEADER, "it holds no poses"),
        ("a.csv", "1,2,3", "pose 1 is not scene_id,im_id"),
        ("a.csv", "48,1,14,1.0,1 0 0 0 1 0 0 0,0 0 800,-1", "8 and 3 numbers"),
        ("a.csv", "48,1,14,1.0,1 0 0 0 1 0 0 0 2,0 0 800,-1", "a rotation matrix, row by row"),
        ("a.csv", "48,1,14,1.0,1 0 0 0 1 0 0 0 -1,0 0 800,-1", "a rotation matrix, row by row"),
        ("a.csv", "48,1,14,1.0,nan 0 0 0 1 0 0 0 1,0 0 800,-1", "a rotation matrix, row by row"),
        ("a.csv", "48,1,14,1.0,inf 0 0 0 1 0 0 0 1,0 0 800,-1", "a rotation matrix, row by row"),
        ("a.csv", "48,1,14,1.0,1 0 0 0 1 0 0 0 1,nan 0 800,-1", "it is read as mm"),
        ("a.csv", 200_000 * "x", "no table of values"),
        ("a.csv", "48,1,14,1.0,1 0 0 0 1 0 0 0 1,0 0 0.8,-1", "it is read as mm"),
        ("a.csv", "48,1,99,1.0,1 0 0 0 1 0 0 0 1,0 0 800,-1", "1 to 21"),
        ("a.json", "[", "not valid JSON"),
        ("a.json", {"025_mug": {"position": [0, 0, 1], "quaternion": [1, 1, 0, 0]}}, "a unit quaternion"),
        ("a.json", {"025_mug": {"position": [0, 0, 800], "quaternion": [1, 0, 0, 0]}}, "it is read as m,"),
        ("a.json", {"025_mug": {"position": [0, 0]}}, "3 finite numbers"),
        ("a.json", {"1": [{"obj_id": 14}]}, "missing"),
        ("a.mat", "no matlab", "no file of MATLAB"),
    ],
)
def test_what_is_no_pose_is_told_in_a_sentence(tmp_path, name, content, sentence):
    with pytest.raises(CorruptFile, match=sentence):
        read_poses(write(tmp_path, name, content))


def test_a_matlab_file_of_something_else_is_told(tmp_path):
    savemat(tmp_path / "a.mat", {"x": 1})
    with pytest.raises(CorruptFile, match="has no variable 'rois'"):
        read_poses(tmp_path / "a.mat")
    savemat(tmp_path / "b.mat", {"rois": np.zeros((2, 6)), "poses": np.zeros((1, 7))})
    with pytest.raises(CorruptFile, match="not 7 numbers for each of its 2 rois"):
        read_poses(tmp_path / "b.mat")


def test_a_missing_file_is_told(tmp_path):
    for name in ("a.csv", "a.json", "a.mat"):
        with pytest.raises(CorruptFile, match="No such file"):
            read_poses(tmp_path / name)
