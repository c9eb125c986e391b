import contextlib
import json

from app.cli.main import main
from app.storage.database import Store


def test_a_running_service_is_backed_up_and_comes_back_elsewhere(tmp_path, capsys):
    source, again, archive = (str(tmp_path / name) for name in ("data", "again", "backup.zip"))
    with contextlib.closing(Store(tmp_path / "data")) as store:  # which holds the lock of the directory
        store.save_job("j", 1, {"x": 1})
        assert main(["backup", archive, "--data-dir", source]) == 0
    assert "backup.zip holds 1 files" in capsys.readouterr().out
    assert main(["restore", archive, "--data-dir", again, "--json"]) == 0
    told = json.loads(capsys.readouterr().out.splitlines()[-1])
    assert (told["data_dir"], told["files"]) == (again, 1)
    with contextlib.closing(Store(tmp_path / "again")) as store:
        assert store.jobs() == ((1, {"x": 1}),)


def test_a_target_that_is_not_empty_is_one_sentence(tmp_path, capsys):
    Store(tmp_path / "data").close()
    data, archive = str(tmp_path / "data"), str(tmp_path / "backup.zip")
    assert main(["backup", archive, "--data-dir", data, "--json"]) == 0
    assert json.loads(capsys.readouterr().out)["path"] == archive
    assert main(["restore", archive, "--data-dir", data]) == 1
    error = capsys.readouterr().err
    assert error.startswith("osf: ")
    assert "move this one away" in error
