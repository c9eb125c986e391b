from pathlib import Path

from app.storage.paths import default_data_dir


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
