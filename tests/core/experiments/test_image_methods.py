import pytest

from osfcore.errors import InvalidInput, MissingAssets, UnknownName
from osfcore.experiments.images import FIELD_METHODS, TITLES, check_methods, common_names, field_path, load_appearance
from osfcore.fields.field_library import FieldLibrary
from tests.core.experiments.nerfs import write_nerfs
from tests.core.experiments.solids import SOLIDS


def test_methods_come_once_and_in_order():
    assert check_methods(["nerf", "ours", "nerf"], FIELD_METHODS) == ("ours", "nerf")
    assert set(FIELD_METHODS) <= set(TITLES)
    with pytest.raises(InvalidInput, match="magic"):
        check_methods(["magic", "ours"], FIELD_METHODS)
    with pytest.raises(InvalidInput, match="none"):
        check_methods([], FIELD_METHODS)


def test_all_methods_know_the_objects_that_are_drawn(library, tmp_path):
    write_nerfs(tmp_path)
    fields = FieldLibrary(None)
    known = common_names(("ours",), None, fields, library, tmp_path, 3)
    assert set(SOLIDS) < set(known)
    assert all(fields.has(name) and library.has(name) for name in known)
    for methods in (("nerf",), ("paper",), ("nerf", "paper", "ours")):
        names = common_names(methods, None, fields, library, tmp_path, 3)
        assert set(SOLIDS) <= set(names) <= set(known)
        for name in names:
            for method in methods:
                assert field_path(method, name, fields, tmp_path).is_file()
    assert common_names(FIELD_METHODS, (SOLIDS[1], SOLIDS[0], SOLIDS[1]), fields, library, tmp_path, 2) == (
        SOLIDS[1],
        SOLIDS[0],
    )


def test_what_cannot_be_shown_by_all_is_told(library, tmp_path):
    fields = FieldLibrary(None)
    with pytest.raises(UnknownName, match="teapot"):
        common_names(("ours",), ("teapot",), fields, library, tmp_path, 1)
    with pytest.raises(UnknownName, match="011_banana"):
        common_names(("paper",), ("011_banana",), fields, library, tmp_path, 1)
    with pytest.raises(MissingAssets, match="011_banana"):
        common_names(("ours",), ("011_banana",), fields, library, tmp_path, 1)
    with pytest.raises(InvalidInput, match="objects in a scene is 9"):
        common_names(("ours",), None, fields, library, tmp_path, 9)
    with pytest.raises(InvalidInput, match="at least 3"):
        common_names(("ours",), SOLIDS[:2], fields, library, tmp_path, 3)


def test_each_method_shows_all_that_are_asked_for(tmp_path):
    write_nerfs(tmp_path)
    renderers = {m: load_appearance(m, SOLIDS, FieldLibrary(None), tmp_path).together for m in FIELD_METHODS}
    assert all(renderer.names == SOLIDS for renderer in renderers.values())
    assert len({type(renderer) for renderer in renderers.values()}) == len(FIELD_METHODS)
