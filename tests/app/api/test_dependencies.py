import shutil

from app.api.dependencies import ObjectCatalogue
from osfcore.objects.asset_library import AssetLibrary
from osfcore.objects.catalogue import CATALOGUE
from tests.app.conftest import until


def test_new_objects_are_seen_soon(data_dir, tmp_path):
    library = AssetLibrary(tmp_path / "catalogue")
    catalogue = ObjectCatalogue(library)
    assert catalogue.names() == ()
    assert catalogue.labels()["025_mug"] == CATALOGUE["025_mug"].label
    shutil.copytree(data_dir / "objects", library.root)
    until(lambda: catalogue.names() == library.names())


def test_a_scene_knows_whether_it_is_shown(services, scene):
    record = services.runner.scene(scene["id"])
    assert services.scene_out(record).is_current
    assert services.scene_out(record).objects[0].label == "Cracker box"
