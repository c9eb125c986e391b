"""Poses of other programs: what is written is read, in the frame of the box's centre."""

import json

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.io import savemat

from osfcore.errors import CorruptFile, InvalidInput, UnknownName
from osfcore.geometry.poses import Pose, quaternion_exp, quaternion_to_matrix, rotation_angle
from osfcore.photo.bop import NAMES, PoseChoice, in_object_frame, name_of, read_poses, scene_gt_names

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


def same(a, b):
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
        assert same(found[1], pose)
    rois, values = np.array([[0, obj, 1, 2, 3, 4]]), np.concatenate([pose.quaternion, pose.position])[None]
    savemat(folder / "000001.mat", {"rois": rois, "poses": values, "poses_icp": values})
    found = read_poses(folder / "000001.mat", PoseChoice(source="poses_icp"))
    assert same(found[name], in_object_frame(pose, name, "ycb_video"))


def test_numbers_are_those_of_ycb_video():
    assert (name_of(1), name_of(14), name_of(21)) == ("002_master_chef_can", "025_mug", "061_foam_brick")
    assert len(set(NAMES)) == 21
    with pytest.raises(InvalidInput, match="1 to 21"):
        name_of(22)


@pytest.mark.parametrize("frame", ["ycb_video", "google_16k"])
@pytest.mark.parametrize("name", ["025_mug", "061_foam_brick"])
def test_frames_differ_by_a_shift_that_turns_with_the_object(name, frame):
    still = in_object_frame(Pose.identity(), name, frame)
    turned = in_object_frame(POSE, name, frame)
    assert same(turned, POSE @ still)
    assert 0 < np.linalg.norm(still.position) < 0.15
    assert same(in_object_frame(POSE, name, "bop"), POSE)


def test_the_frame_is_that_of_the_kind_of_file_unless_told(tmp_path):
    path = write(tmp_path, "bop.csv", bop_line())
    told = read_poses(path, PoseChoice(frame="ycb_video"))["025_mug"]
    assert same(told, in_object_frame(POSE, "025_mug", "ycb_video"))


def test_an_origin_that_is_not_known_is_told(tmp_path):
    path = write(tmp_path, "bop.csv", bop_line(obj=17))
    assert "037_scissors" in read_poses(path)
    with pytest.raises(UnknownName, match="google_16k named '037_scissors'"):
        read_poses(path, PoseChoice(frame="google_16k"))


def test_the_best_score_counts(tmp_path):
    other = Pose(POSE.position + 0.1, POSE.quaternion)
    lines = [bop_line(other, score=0.2), bop_line(score=0.9), bop_line(other, score=0.5)]
    assert same(read_poses(write(tmp_path, "bop.csv", "\n".join(lines)))["025_mug"], POSE)


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
