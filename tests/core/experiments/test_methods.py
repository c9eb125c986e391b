import pytest

from osfcore.errors import InvalidInput, MissingAssets, UnknownName
from osfcore.experiments.methods import FIELD_METHODS, check_methods, common_names, field_path, load_appearance
from osfcore.fields.field_library import FieldLibrary
from tests.support.errors import about
from tests.support.solids import SOLIDS, write_nerfs


def test_methods_come_once_and_in_order():
    assert check_methods(["nerf", "ours", "nerf"], FIELD_METHODS) == ("ours", "nerf")
    for wrong in (["magic", "ours"], []):
        with pytest.raises(InvalidInput):
            check_methods(wrong, FIELD_METHODS)


def test_all_methods_know_the_objects_that_are_drawn(library, tmp_path):
    write_nerfs(tmp_path)
    fields = FieldLibrary(None)
    for methods in (("ours",), ("nerf", "paper", "ours")):
        names = common_names(methods, None, fields, library, tmp_path, 3)
        assert set(SOLIDS) <= set(names) <= set(library.names())
        assert all(field_path(method, name, fields, tmp_path).is_file() for name in names for method in methods)
    again = (SOLIDS[1], SOLIDS[0], SOLIDS[1])
    assert common_names(FIELD_METHODS, again, fields, library, tmp_path, 2) == again[:2]


@pytest.mark.parametrize(
    ("methods", "names", "count", "error", "what"),
    [
        (("ours",), ("teapot",), 1, UnknownName, "teapot"),
        (("paper",), ("011_banana",), 1, UnknownName, "011_banana"),
        (("ours",), ("011_banana",), 1, MissingAssets, "011_banana"),
        (("ours",), None, 9, InvalidInput, "objects in a scene"),
        (("ours",), SOLIDS[:2], 3, InvalidInput, "number of objects"),
    ],
)
def test_what_some_method_cannot_show_is_refused(library, tmp_path, methods, names, count, error, what):
    with pytest.raises(error, check=about(what)):
        common_names(methods, names, FieldLibrary(None), library, tmp_path, count)


def test_each_method_shows_all_that_are_asked_for(tmp_path):
    write_nerfs(tmp_path)
    renderers = [load_appearance(m, SOLIDS, FieldLibrary(None), tmp_path).together for m in FIELD_METHODS]
    assert all(renderer.names == SOLIDS for renderer in renderers)
    assert len(set(map(type, renderers))) == len(FIELD_METHODS)
