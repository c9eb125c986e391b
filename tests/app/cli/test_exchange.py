"""`osf export` and `osf import`: what they write, and what they say of mistakes."""

import io
import json
import sys
from importlib.resources import files
from pathlib import Path

import gsply
import numpy as np
import pytest
import trimesh
from pxr import Usd, UsdGeom

from app.cli.exchange import Check
from app.cli.main import main
from osfcore.errors import CorruptFile, InvalidInput
from osfcore.fields.kiloosf import write_field
from osfcore.geometry.cameras import default_cameras
from osfcore.io.observation_file import read_observation
from osfcore.io.scene_file import Scene, scene_to_json
from osfcore.world.collect_images import CollectTable, collect_table
from osfcore.world.scenes import SceneRequest
from osfcore.world.tabletop import Tabletop
from tests.support.bop_scenes import write_bop_scene
from tests.support.ellipsoid import HALF, ellipsoid_field
from tests.support.ellipsoid_sets import turn_cameras, write_set
from tests.support.errors import about

NAMES = ("003_cracker_box", "006_mustard_bottle")


@pytest.fixture(scope="module")
def rendered(library):
    cameras = default_cameras(64)
    world = Tabletop(library, cameras=cameras, request=SceneRequest(NAMES, 2))
    try:
        world.arrange(3)
        return world.render(cameras, masks=True, with_pusher=False), world.truth()
    finally:
        world.close()


@pytest.fixture
def field_file(tmp_path):
    path = tmp_path / "solid.safetensors"
    write_field(path, ellipsoid_field())
    return path


def result_of(capsys):
    return json.loads(capsys.readouterr().out.splitlines()[-1])


def test_a_scene_comes_with_meshes_where_there_are_some(rendered, data_dir, tmp_path, capsys):
    scene = tmp_path / "scene.json"
    scene.write_text(json.dumps(scene_to_json(Scene(rendered[1], default_cameras(64)))))
    arguments = ["export", "scene", "--scene", str(scene), "--out", str(tmp_path / "scene.glb"), "--json"]
    assert main([*arguments, "--data-dir", str(data_dir)]) == 0
    result = result_of(capsys)
    assert (sorted(result["meshes"]), result["fields"]) == (list(NAMES), [])
    content = (tmp_path / "scene.glb").read_bytes()
    assert len(content) == result["bytes"]
    read = trimesh.load_scene(io.BytesIO(content), file_type="glb")
    assert set(NAMES) | {"table", "pusher"} == set(read.geometry)
    assert b"KHR_lights_punctual" in content
    assert main([*arguments, "--data-dir", str(data_dir), "--no-light"]) == 0
    assert b"KHR_lights_punctual" not in (tmp_path / "scene.glb").read_bytes()


def test_a_field_from_a_file_becomes_a_mesh(field_file, tmp_path, capsys):
    out = tmp_path / "solid.glb"
    assert main(["export", "field", str(field_file), "--out", str(out), "--light", "1", "0", "1"]) == 0
    assert "those under the light toward (1.0, 0.0, 1.0), baked in" in capsys.readouterr().out
    mesh = trimesh.load_scene(out).geometry["solid"]
    np.testing.assert_allclose(mesh.extents, 2 * HALF, atol=2e-3)


def test_the_same_comes_as_usd(rendered, field_file, tmp_path, capsys, data_dir):
    scene = tmp_path / "scene.json"
    scene.write_text(json.dumps(scene_to_json(Scene(rendered[1], default_cameras(64)))))
    arguments = ["export", "scene", "--scene", str(scene), "--out", str(tmp_path / "scene.usdz"), "--json"]
    assert main([*arguments, "--data-dir", str(data_dir)]) == 0
    assert sorted(result_of(capsys)["meshes"]) == list(NAMES)
    stage = Usd.Stage.Open(str(tmp_path / "scene.usdz"))
    kinds = [prim.GetTypeName() for prim in stage.Traverse()]
    assert (kinds.count("Mesh"), kinds.count("Camera"), kinds.count("DistantLight")) == (4, 4, 1)
    arguments[arguments.index("--out") + 1] = str(tmp_path / "unlit.usdz")
    assert main([*arguments, "--data-dir", str(data_dir), "--no-light"]) == 0
    unlit = Usd.Stage.Open(str(tmp_path / "unlit.usdz"))
    assert "DistantLight" not in [prim.GetTypeName() for prim in unlit.Traverse()]
    for suffix in (".usdz", ".usdc"):
        out = tmp_path / f"solid{suffix}"
        assert main(["export", "field", str(field_file), "--out", str(out), "--light", "1", "0", "1"]) == 0
        assert "baked in" in capsys.readouterr().out
        stage = Usd.Stage.Open(str(out))
        (mesh,) = (prim for prim in stage.Traverse() if prim.IsA(UsdGeom.Mesh))
        np.testing.assert_allclose(np.ptp(UsdGeom.Mesh(mesh).GetExtentAttr().Get(), axis=0), 2 * HALF, atol=2e-3)


def test_usd_is_refused_in_words_where_its_library_is_missing(field_file, tmp_path, capsys, monkeypatch):
    monkeypatch.setattr("osfcore.extras.find_spec", lambda name: None)
    for module in [name for name in sys.modules if name.startswith("osfcore.contrib.export.usd")]:
        monkeypatch.delitem(sys.modules, module)
    assert main(["export", "field", str(field_file), "--out", str(tmp_path / "solid.usdz")]) == 1
    assert "A USD file needs pxr, which is not installed; get it with: pip install 'osf-manipulation[usd]'." in (
        capsys.readouterr().err
    )


def test_splats_say_that_their_light_is_baked_in(field_file, tmp_path, capsys):
    out = tmp_path / "solid.ply"
    assert main(["export", "splats", str(field_file), "--out", str(out)]) == 0
    assert "lighting baked in, light toward (0.0, 0.0, 1.0)" in capsys.readouterr().out
    assert b"comment Lighting is baked in: light toward (0.0000, 0.0000, 1.0000)" in out.read_bytes()[:300]
    np.testing.assert_allclose(np.ptp(gsply.plyread(out).means, axis=0), 2 * HALF, atol=4e-3)


def test_a_scene_of_bop_goes_in_and_its_poses_come_out(rendered, tmp_path, capsys):
    write_bop_scene(tmp_path / "000048", *rendered)
    seen, state = tmp_path / "seen", tmp_path / "state.json"
    assert main(["import", "bop", str(tmp_path / "000048"), "--out", str(seen), "--images", "3", "9", "--json"]) == 0
    assert result_of(capsys) == {
        "out": str(seen),
        "images": [3, 9],
        "objects": list(NAMES),
        "left_out": [],
        "notes": [],
    }
    assert [camera.name for camera in read_observation(seen).cameras] == ["3", "9"]
    poses = json.loads((seen / "poses.json").read_text())
    for name in NAMES:
        np.testing.assert_allclose(poses[name]["position"], rendered[1].pose(name).position, atol=1e-6)
    state.write_text(json.dumps(scene_to_json(Scene(rendered[1], ()))))
    arguments = [
        "--state",
        str(state),
        "--observation",
        str(seen),
        "--scene",
        "48",
        "--out",
        str(tmp_path / "ours.csv"),
    ]
    assert main(["export", "bop", *arguments]) == 0
    assert "4 poses in 2 images of scene 48" in capsys.readouterr().out
    assert len((tmp_path / "ours.csv").read_text().splitlines()) == 5
    assert main(["check", str(tmp_path / "ours.csv")]) == 0
    assert "is a good results file of BOP: 4 poses of 2 objects in 2 images." in capsys.readouterr().out


@pytest.mark.parametrize(
    ("code", "arguments", "sentence"),
    [
        (1, ("export", "scene", "--scene", "none.json", "--out", "a.glb"), "none.json cannot be used"),
        (2, ("export", "field", "009_gelatin_box", "--out", "a.obj"), "a path that ends in .glb or .usdz or .usdc"),
        (2, ("export", "scene", "--scene", "none.json", "--out", "a.usdc"), "a path that ends in .glb or .usdz"),
        (2, ("export", "field", "spoon", "--out", "a.glb"), "There is no field named 'spoon'"),
        (2, ("export", "splats", "009_gelatin_box", "--out", "a.glb"), "must be a path that ends in .ply"),
        (2, ("export", "splats", "009_gelatin_box", "--out", "a.ply", "--light", "0", "0", "-1"), "light elevation"),
        (1, ("import", "bop", "none", "--out", "a"), "scene_camera.json cannot be used"),
        (2, ("import", "bop", "none", "--out", "."), "must be new or empty"),
    ],
)
def test_mistakes_are_told_in_words(code, arguments, sentence, tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    (tmp_path / "something").write_text("")
    assert main([*arguments]) == code
    error = capsys.readouterr().err
    assert sentence in error
    assert error.count("\n") == 1


def test_a_good_set_is_described_and_drawn(tmp_path, capsys):
    out = tmp_path / "table"
    list(collect_table(CollectTable(out, images=60, size=16)))
    result = Check(out, overlay=tmp_path / "overlay.png").run()
    assert result == {"path": str(out), "kind": "image set", "train": 20, "test": 40}
    assert "good image set: 20 train and 40 test images" in capsys.readouterr().out
    assert (tmp_path / "overlay.png").stat().st_size > 1000


def test_a_bad_set_is_drawn_before_it_is_refused(tmp_path, capsys):
    folder, overlay = write_set(tmp_path / "set"), tmp_path / "overlay.png"
    turn_cameras(folder, lambda RT: np.diag([1, -1, -1]) @ RT)
    with pytest.raises(CorruptFile):
        Check(folder, overlay=overlay).run()
    assert overlay.stat().st_size > 1000
    assert "overlay.png shows how cameras" in capsys.readouterr().out
    overlay.unlink()
    (folder / "train" / "r_0.png").unlink()
    with pytest.raises(CorruptFile, check=about("r_0.png")):
        Check(folder, overlay=overlay).run()
    assert not overlay.exists()
    assert capsys.readouterr().out == ""


def test_poses_as_nerf_has_them_are_told_with_an_overlay_and_without(tmp_path):
    """Camera-to-world with OpenGL axes, read as world-to-camera, puts all cameras into one place."""
    folder, overlay = write_set(tmp_path / "set"), tmp_path / "overlay.png"
    turn_cameras(folder, lambda RT: (np.linalg.inv(np.vstack([RT, [0, 0, 0, 1]])) @ np.diag([1, -1, -1, 1]))[:3])
    for place in (None, overlay):
        with pytest.raises(CorruptFile, check=about("RT must be world-to-camera")):
            Check(folder, overlay=place).run()
    assert overlay.stat().st_size > 1000


@pytest.mark.parametrize("file", ["transforms.json", "transforms_train.json"])
def test_data_sets_of_nerf_are_called_by_name(tmp_path, file):
    frames = [{"file_path": "images/0.png", "transform_matrix": np.eye(4).tolist()}]
    (tmp_path / file).write_text(json.dumps({"camera_angle_x": 0.7, "frames": frames}))
    for path in (tmp_path, tmp_path / file):
        for overlay in (None, tmp_path / "overlay.png"):
            with pytest.raises(CorruptFile, check=about("instant-ngp or nerfstudio")):
                Check(path, overlay=overlay).run()


def test_an_overlay_of_another_kind_is_refused_for_good_and_bad_sets(tmp_path):
    good, bad = write_set(tmp_path / "good"), write_set(tmp_path / "bad")
    turn_cameras(bad, lambda RT: np.diag([1, -1, -1]) @ RT)
    for folder in (good, bad):
        with pytest.raises(InvalidInput, check=about("overlay file")):
            Check(folder, overlay=tmp_path / "o.jpg").run()


def test_with_json_nothing_else_is_printed(tmp_path, capsys):
    path = tmp_path / "scene.json"
    path.write_text(json.dumps({"objects": [], "light": {"position": [0, 0, 1]}}))
    assert Check(path, json=True).run()["objects"] == 0
    assert capsys.readouterr().out == ""


def test_what_is_not_there_is_told(tmp_path):
    with pytest.raises(CorruptFile):
        Check(tmp_path / "nothing").run()


def test_weights_are_described_and_broken_ones_refused(tmp_path):
    shipped = Path(str(files("osfcore.fields") / "shipped"))
    assert Check(shipped / "table.safetensors").run()["kind"] == "field"
    good = (shipped / "006_mustard_bottle.safetensors").read_bytes()
    whole, short, other = (tmp_path / f"{name}.safetensors" for name in ("whole", "short", "other"))
    whole.write_bytes(good)
    assert Check(whole).run()["kind"] == "field"
    short.write_bytes(good[: len(good) // 2])
    with pytest.raises(CorruptFile):
        Check(short).run()
    other.write_bytes(good.replace(b"kiloosf-1", b"kiloosf-0"))
    with pytest.raises(CorruptFile, check=about("kiloosf-0")):
        Check(other).run()
