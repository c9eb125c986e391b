from pathlib import Path

import pytest

import osfcore
from app.storage.paths import default_data_dir, without_places


def test_the_environment_chooses(monkeypatch, tmp_path):
    monkeypatch.setenv("OSF_DATA_DIR", str(tmp_path))
    assert default_data_dir() == tmp_path


def test_otherwise_it_is_the_users_own_folder(monkeypatch):
    monkeypatch.delenv("OSF_DATA_DIR", raising=False)
    assert default_data_dir().is_absolute()
    assert "osf" in default_data_dir().name


def test_tilde_is_home(monkeypatch):
    monkeypatch.setenv("OSF_DATA_DIR", "~/osf-data")
    assert default_data_dir() == Path.home() / "osf-data"


@pytest.mark.parametrize(
    ("text", "plain"),
    [
        ("{}/goals/x.png cannot be used.", "goals/x.png cannot be used."),
        ("'{}/a b' and {}/c", "'a b' and c"),
        (r"{}\goals\x.png and '{}\\goals'", r"goals\x.png and 'goals'"),
        ("{} cannot be written.", "The data directory cannot be written."),
        ("Nothing fits into {}.", "Nothing fits into the data directory."),
        ("It is {}2/x, not /mnt{}/x.", "It is {}2/x, not /mnt{}/x."),
        ("It is {}.old/x.", "It is {}.old/x."),
        ("1/2 and /etc", "1/2 and /etc"),
    ],
)
def test_sentences_name_files_from_the_data_directory_on(tmp_path, text, plain):
    data_dir = tmp_path / "my (data)"
    assert without_places(text.replace("{}", str(data_dir)), data_dir) == plain.replace("{}", str(data_dir))


def test_links_and_relative_names_of_the_data_directory_hide_as_much(tmp_path, monkeypatch):
    (tmp_path / "true").mkdir()
    (tmp_path / "link").symlink_to(tmp_path / "true")
    monkeypatch.chdir(tmp_path)
    for name in ("link", "true"):
        assert without_places(f"{tmp_path}/{name}/goals is full.", Path("link")) == "goals is full."


def test_the_programs_own_files_are_named_from_its_packages_on(tmp_path):
    shipped = Path(osfcore.__path__[0]) / "fields" / "shipped" / "mug.safetensors"
    assert without_places(f"{shipped} is damaged.", tmp_path) == "osfcore/fields/shipped/mug.safetensors is damaged."
