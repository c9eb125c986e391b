import json
import zipfile

import numpy as np
import pytest
import trimesh
import tyro
from PIL import Image

from app.cli.assets import Assets, AssetsAdd, AssetsFetch, AssetsList
from app.cli.command import Command
from osfcore.errors import CorruptFile, InvalidInput, UnknownName
from osfcore.objects.asset_library import AssetLibrary
from tests.support.errors import about


def parse(*arguments: str) -> Command:
    return tyro.cli(Assets, args=arguments)


def test_arguments_are_read_as_documented(tmp_path):
    listed = parse("list", "--json", "--data-dir", str(tmp_path))
    assert listed == AssetsList(data_dir=tmp_path, json=True)
    fetched = parse("fetch", "024_bowl", "025_mug", "--source", "/x", "--force", "--data-dir", str(tmp_path))
    assert fetched == AssetsFetch(("024_bowl", "025_mug"), source="/x", force=True, data_dir=tmp_path)
    added = parse("add", "a.glb", "--name", "cup", "--mass", "0.2", "--data-dir", str(tmp_path))
    assert isinstance(added, AssetsAdd)
    assert (added.mesh.name, added.name, added.mass) == ("a.glb", "cup", 0.2)


def test_list_before_anything_was_fetched(tmp_path, capsys):
    result = AssetsList(data_dir=tmp_path / "none").run()
    table = capsys.readouterr().out
    assert len(result["objects"]) == 20
    assert not any(row["available"] for row in result["objects"])
    assert "024_bowl" in table
    assert "CC-BY-4.0" in table
    assert max(map(len, table.splitlines())) <= 80
    json.dumps(result)


@pytest.mark.slow
def test_fetch_list_and_json(data_dir, ycb_folder, capsys):
    result = AssetsFetch(("009_gelatin_box",), source=str(ycb_folder), force=True, data_dir=data_dir, json=True).run()
    assert result["objects"] == ["009_gelatin_box"]
    assert "009_gelatin_box" in result["available"]
    rows = {row["name"]: row for row in AssetsList(data_dir=data_dir, json=True).run()["objects"]}
    assert rows["009_gelatin_box"]["available"]
    assert rows["009_gelatin_box"]["size_m"] == pytest.approx([0.089, 0.101, 0.030], abs=0.002)
    captured = capsys.readouterr()
    assert captured.out == ""  # with --json only the caller writes to stdout
    assert "gelatin box" in captured.err


def test_add_shows_in_the_list(tmp_path, capsys):
    trimesh.creation.icosphere(2, 0.04).export(tmp_path / "ball.ply")
    row = AssetsAdd(tmp_path / "ball.ply", name="ball", mass=0.2, data_dir=tmp_path / "data").run()
    assert row["available"]
    assert row["collision_parts"] == 1
    assert "Added ball: 8 x 8 x 8 cm" in capsys.readouterr().out
    names = [r["name"] for r in AssetsList(data_dir=tmp_path / "data", json=True).run()["objects"]]
    assert names == sorted(names)
    assert "ball" in names


def test_add_finds_files_as_the_page_does_and_names_what_is_missing(tmp_path):
    box = trimesh.creation.box((0.1, 0.06, 0.04))
    lines = [f"v {x} {y} {z}" for x, y, z in box.vertices] + ["vt 0.5 0.5"]
    lines += ["f " + " ".join(f"{corner + 1}/1" for corner in face) for face in box.faces]
    (tmp_path / "box.obj").write_text("\n".join(["mtllib C:\\made\\BOX.MTL", "usemtl red", *lines]))
    (tmp_path / "box.mtl").write_text("newmtl red\nmap_Kd -s 1 1 1 Paint.PNG\n")
    add = AssetsAdd(tmp_path / "box.obj", name="box", data_dir=tmp_path / "data")
    with pytest.raises(CorruptFile, check=about("Paint.PNG")):
        add.run()
    assert AssetLibrary(tmp_path / "data" / "objects").names() == ()
    Image.new("RGB", (8, 8), (200, 30, 30)).save(tmp_path / "paint.png")
    assert add.run()["available"]
    with zipfile.ZipFile(tmp_path / "box.zip", "w") as archive:
        for name in ("box.obj", "box.mtl", "paint.png"):
            archive.write(tmp_path / name, f"box/{name}")
    assert AssetsAdd(tmp_path / "box.zip", name="zipped", data_dir=tmp_path / "data").run()["available"]
    for name in ("box", "zipped"):
        texture = AssetLibrary(tmp_path / "data" / "objects").load(name).mesh.texture
        assert np.all(texture == (200, 30, 30))


@pytest.mark.slow
def test_bad_input_is_an_error_of_ours(tmp_path):
    with pytest.raises(InvalidInput, check=about("source")):
        AssetsFetch(source=str(tmp_path / "none"), data_dir=tmp_path).run()
    with pytest.raises(InvalidInput, check=about("workers")):
        AssetsFetch(workers=0, data_dir=tmp_path).run()
    with pytest.raises(UnknownName, check=about("nonsense")):
        AssetsFetch(("nonsense",), data_dir=tmp_path).run()
    assert list(tmp_path.iterdir()) == []
