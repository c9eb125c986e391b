from pathlib import PurePath

from app.episodes import file_names as names


def test_names_are_plain_and_all_different():
    values = [value for key, value in vars(names).items() if key.isupper()]
    assert len(values) >= 6
    assert len(set(values)) == len(values)
    assert all(PurePath(value).name == value and not value.startswith(".") for value in values)
