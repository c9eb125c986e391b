import pytest
from pydantic import ValidationError

from app.services.service_settings import Settings


def test_environment_is_read_and_lists_are_split(monkeypatch, tmp_path):
    monkeypatch.setenv("OSF_DATA_DIR", str(tmp_path))
    monkeypatch.setenv("OSF_ALLOWED_HOSTS", "lab.example, other.example,")
    monkeypatch.setenv("OSF_MAX_SCENES", "3")
    settings = Settings()
    assert settings.data_dir == tmp_path
    assert settings.allowed_hosts == ("lab.example", "other.example")
    assert (settings.max_scenes, settings.port, settings.host) == (3, 8000, "127.0.0.1")


@pytest.mark.parametrize(("name", "value"), [("port", 70000), ("max_scenes", 0), ("cancel_grace_s", -1)])
def test_nonsense_is_refused(name, value):
    with pytest.raises(ValidationError):
        Settings(**{name: value})
