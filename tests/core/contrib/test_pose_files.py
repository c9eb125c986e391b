"""Poses in the formats of BOP, PoseCNN, FoundationPose, DOPE and happypose."""

import json

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.io import savemat

from osfcore.contrib.bop import NAMES
from osfcore.contrib.pose_files import PoseChoice, in_object_frame, read_poses
from osfcore.errors import CorruptFile, InvalidInput, UnknownName
from osfcore.geometry.poses import Pose, quaternion_exp, quaternion_to_matrix, rotation_angle
from tests.support.bop_scenes import annotation, write_models_info
from tests.support.errors import about

# Poses of other programs: what is written is read, in the frame of the box's centre.


HEADER = "scene_id,im_id,obj_id,score,R,t,time"
POSE = Pose(np.array([0.05, -0.1, 0.8]), quaternion_exp(np.array([0.4, -1.2, 0.3])))


def same(a, b):
    return np.abs(a.position - b.position).max() < 1e-6 and rotation_angle(a.quaternion, b.quaternion) < 1e-5


def refused(kind, what, read, *arguments):
    with pytest.raises(kind, check=about(what)):
        read(*arguments)


def bop_line(pose=POSE, obj=14, scene=48, image=1, score=1.0):
    parts = quaternion_to_matrix(pose.quaternion), 1e3 * pose.position
    R, t = (" ".join(repr(float(v)) for v in np.ravel(part)) for part in parts)
    return f"{scene},{image},{obj},{score},{R},{t},-1"


def write(folder, name, content):
    path = folder / name
    path.write_text(content if isinstance(content, str) else json.dumps(content))
    return path


@given(
    turn=st.lists(st.floats(-1.8, 1.8), min_size=3, max_size=3),
    position=st.tuples(st.floats(-0.5, 0.5), st.floats(-0.5, 0.5), st.floats(0.1, 3.0)),
    obj=st.integers(1, 21),
)
@settings(max_examples=15)
def test_poses_survive_every_form(tmp_path_factory, turn, position, obj):
    folder = tmp_path_factory.mktemp("poses")
    pose, name = Pose(np.array(position), quaternion_exp(np.array(turn))), NAMES[obj - 1]
    entry = {"position": pose.position.tolist(), "quaternion": pose.quaternion.tolist()}
    written = [
        write(folder, "bop.csv", f"{HEADER}\n{bop_line(pose, obj)}\n"),
        write(folder, "bare.csv", bop_line(pose, obj)),
        write(folder, "scene_gt.json", {"3": [annotation(pose, obj)]}),
        write(folder, "plain.json", {name: entry}),
        write(folder, "photo.json", {"poses_camera_object": {"mine": {name: entry}}, "image": "photo.png"}),
    ]
    for path in written:
        ((read, found),) = read_poses(path).items()
        assert read == name
        assert same(found, pose)
    rois, values = np.array([[0, obj, 1, 2, 3, 4]]), np.concatenate([pose.quaternion, pose.position])[None]
    savemat(folder / "000001.mat", {"rois": rois, "poses": values, "poses_icp": values})
    found = read_poses(folder / "000001.mat", PoseChoice(source="poses_icp"))
    assert same(found[name], in_object_frame(pose, name, "ycb_video"))


def test_the_frame_is_that_of_the_kind_of_file_unless_given_and_frames_differ_by_a_shift(tmp_path):
    for name in ("025_mug", "061_foam_brick"):
        assert same(in_object_frame(POSE, name, "bop"), POSE)
        for frame in ("ycb_video", "google_16k"):
            still = in_object_frame(Pose.identity(), name, frame)
            assert same(in_object_frame(POSE, name, frame), POSE @ still)  # it turns with the object
            assert 0 < np.linalg.norm(still.position) < 0.15
    path = write(tmp_path, "bop.csv", bop_line())
    given = read_poses(path, PoseChoice(frame="ycb_video"))["025_mug"]
    assert same(given, in_object_frame(POSE, "025_mug", "ycb_video"))
    path = write(tmp_path, "bop.csv", bop_line(obj=17))
    assert "037_scissors" in read_poses(path)
    refused(UnknownName, "037_scissors", read_poses, path, PoseChoice(frame="google_16k"))


def test_the_best_score_counts_and_rows_of_posecnn_without_a_pose_do_not(tmp_path):
    other = Pose(POSE.position + 0.1, POSE.quaternion)
    lines = [bop_line(other, score=0.2), bop_line(score=0.9), bop_line(other, score=0.5)]
    assert same(read_poses(write(tmp_path, "bop.csv", "\n".join(lines)))["025_mug"], POSE)
    poses = np.stack([np.zeros(7), np.concatenate([POSE.quaternion, POSE.position])])
    savemat(tmp_path / "a.mat", {"rois": np.array([[0, 1, 0, 0, 9, 9, 0.9], [0, 14, 0, 0, 9, 9, 0.8]]), "poses": poses})
    assert list(read_poses(tmp_path / "a.mat")) == ["025_mug"]


def test_images_and_scenes_are_chosen(tmp_path):
    lines = [HEADER, bop_line(), bop_line(obj=1, image=36), bop_line(obj=2, scene=50)]
    path = write(tmp_path, "bop.csv", "\n".join(lines))
    refused(InvalidInput, "scene of the poses", read_poses, path)
    refused(InvalidInput, "image of the poses", read_poses, path, PoseChoice(7, 48))
    assert list(read_poses(path, PoseChoice(36, 48))) == ["002_master_chef_can"]
    content = {"1": [annotation(POSE, 14)], "36": [annotation(POSE, 5), annotation(POSE, 2)]}
    gt = write(tmp_path, "scene_gt.json", content)
    assert list(read_poses(gt, PoseChoice(1))) == ["025_mug"]
    assert set(read_poses(gt, PoseChoice(36))) == {"006_mustard_bottle", "003_cracker_box"}

    entry = {"025_mug": {"position": [0, 0, 1], "quaternion": [1, 0, 0, 0]}}
    path = write(tmp_path, "photo.json", {"poses_camera_object": {"posecnn_raw": entry, "truth": entry}})
    refused(CorruptFile, "source of the poses", read_poses, path)
    assert list(read_poses(path, PoseChoice(source="truth"))) == ["025_mug"]


DOPE = {"class": "mug", "location": [5, -10, 80], "quaternion_xyzw": [0.0, 0.0, 0.0, 1.0]}


def xyzw(quaternion):
    return [*quaternion[1:].tolist(), float(quaternion[0])]


@pytest.mark.parametrize("label", ["cracker", "003_cracker_box", "003_cracker_box_16k", "Cracker_Box"])
def test_poses_of_dope_are_turned_into_the_frame_of_the_object(tmp_path, label):
    """NVIDIA's fixed_model_transform of the cracker box: rows (0, 0, 1), (-1, 0, 0), (0, -1, 0), for points in rows."""
    rows = np.array([[0, 0, 1.0], [-1, 0, 0], [0, -1, 0]])
    there = {"location": (100 * POSE.position).tolist(), "quaternion_xyzw": xyzw(POSE.quaternion), "visibility": 1}
    ours = quaternion_to_matrix(POSE.quaternion) @ rows.T
    other = {**DOPE, "class": "Mustard"}  # that of HOPE, a toy
    path = write(tmp_path, "000.json", {"camera_data": {}, "objects": [{"class": label, **there}, other]})
    found = read_poses(path)
    assert set(found) == {"003_cracker_box", "Mustard"}
    bare = write(tmp_path, "001.json", {"objects": [{"class": label, **there}]})
    assert same(read_poses(bare)["003_cracker_box"], found["003_cracker_box"])
    np.testing.assert_allclose(quaternion_to_matrix(found["003_cracker_box"].quaternion), ours, atol=1e-4)
    np.testing.assert_allclose(found["003_cracker_box"].position, POSE.position, atol=1e-4)
    assert same(read_poses(path, PoseChoice(frame="bop"))["003_cracker_box"], POSE)


def test_a_matrix_of_foundationpose_is_of_the_object_that_it_is_named_after_or_that_is_alone(tmp_path):
    matrix = np.eye(4)
    matrix[:3, :3], matrix[:3, 3] = quaternion_to_matrix(POSE.quaternion), POSE.position
    folder = tmp_path / "025_mug" / "ob_in_cam"
    folder.mkdir(parents=True)
    np.savetxt(folder / "0000.txt", matrix)
    both = ("025_mug", "003_cracker_box")
    for names, name in ((("003_cracker_box",), "003_cracker_box"), (both, "025_mug")):
        ((read, found),) = read_poses(folder / "0000.txt", PoseChoice(names=names)).items()
        assert read == name
        assert same(found, POSE)
    for text in ("\n".join(" ".join(map(str, row)) for row in matrix[:3]), str(matrix.tolist())):
        (tmp_path / "025_mug.txt").write_text(text)
        assert same(read_poses(tmp_path / "025_mug.txt", PoseChoice(names=both))["025_mug"], POSE)
    np.savetxt(tmp_path / "0000.txt", matrix)
    refused(InvalidInput, "object of the pose", read_poses, tmp_path / "0000.txt", PoseChoice(names=both))
    shifted = read_poses(tmp_path / "0000.txt", PoseChoice(frame="ycb_video", names=("025_mug",)))
    assert same(shifted["025_mug"], in_object_frame(POSE, "025_mug", "ycb_video"))


def test_poses_of_happypose_and_of_a_data_set_with_names_of_its_own(tmp_path):
    two = [xyzw(POSE.quaternion), POSE.position.tolist()]
    path = write(tmp_path, "object_data.json", [{"label": "ycbv-obj_000014", "TWO": two}, {"label": "ape", "TWO": two}])
    assert all(same(pose, POSE) for pose in read_poses(path).values())
    assert set(read_poses(path)) == {"025_mug", "ape"}
    centre = np.array([0.01, 0.0, 0.02])
    write_models_info(tmp_path / "data" / "models", {"025_mug": centre}, names={"025_mug": "cup"})
    scene = tmp_path / "data" / "test" / "000001"
    scene.mkdir(parents=True)
    gt = write(scene, "scene_gt.json", {"1": [annotation(POSE, 14), annotation(POSE, 30)]})
    found = read_poses(gt)
    assert set(found) == {"cup", "object 30"}
    assert same(found["cup"], Pose(POSE.apply(centre), POSE.quaternion))


def test_an_object_that_is_there_several_times_has_no_pose(tmp_path):
    gt = write(tmp_path, "scene_gt.json", {"1": [annotation(POSE, 14), annotation(POSE, 14), annotation(POSE, 2)]})
    assert list(read_poses(gt)) == ["003_cracker_box"]


ONE = "1 0 0 0 1 0 0 0 1"


@pytest.mark.parametrize(
    ("name", "content", "what"),
    [
        ("a.pkl", "", "poses come in"),
        ("025_mug.txt", "", "4 x 4"),
        ("025_mug.txt", "1 0 0 0 0 1 0 0 0 0 1 0.8 0 0 0 2", "4 x 4"),
        ("025_mug.txt", "1 0 0 0 0 1 0 0 0 0 2 0.8 0 0 0 1", "rotation"),
        ("025_mug.txt", "1 0 0 0 0 1 0 0 0 0 1 800 0 0 0 1", "read as m,"),
        ("a.csv", HEADER, "no poses"),
        ("a.csv", "1,2,3", "pose 1"),
        ("a.csv", "48,1,14,1.0,1 0 0 0 1 0 0 0,0 0 800,-1", "8 and 3 numbers"),
        ("a.csv", "48,1,14,1.0,1 0 0 0 1 0 0 0 2,0 0 800,-1", "rotation"),
        ("a.csv", "48,1,14,1.0,1 0 0 0 1 0 0 0 -1,0 0 800,-1", "rotation"),
        ("a.csv", "48,1,14,1.0,nan 0 0 0 1 0 0 0 1,0 0 800,-1", "rotation"),
        ("a.csv", "48,1,14,1.0,inf 0 0 0 1 0 0 0 1,0 0 800,-1", "rotation"),
        ("a.csv", f"48,1,14,1.0,{ONE},nan 0 800,-1", "position"),
        ("a.csv", f"48,1,14,1.0,{ONE},0 0 0.8,-1", "read as mm"),
        ("a.csv", 200_000 * "x", "table of values"),
        ("a.json", "[", "JSON"),
        ("a.json", {"025_mug": {"position": [0, 0, 1], "quaternion": [1, 1, 0, 0]}}, "quaternion of 025_mug"),
        ("a.json", {"025_mug": {"position": [0, 0, 800], "quaternion": [1, 0, 0, 0]}}, "read as m,"),
        ("a.json", {"1": [{"obj_id": 14}]}, "cam_R_m2c"),
        ("a.json", {"camera_data": {}, "objects": [{"class": "mug", "location": [0, 0, 80]}]}, "quaternion_xyzw"),
        ("a.json", {"camera_data": {}, "objects": [{**DOPE, "location": [0, 0, 0.8]}]}, "read as cm"),
        ("a.json", [{"label": "obj_000014", "TWO": [[0, 0, 0, 1]]}], "TWO"),
        ("a.mat", "no matlab", "MATLAB"),
        ("a.mat", {"x": 1}, "'rois'"),
        ("a.mat", {"rois": np.zeros((2, 6)), "poses": np.zeros((1, 7))}, "poses are not"),
    ],
)
def test_files_without_sound_poses_are_refused(tmp_path, name, content, what):
    if name.endswith(".mat") and isinstance(content, dict):
        savemat(tmp_path / name, content)
    else:
        write(tmp_path, name, content)
    refused(CorruptFile, what, read_poses, tmp_path / name, PoseChoice(names=("025_mug",)))
