import logging
import os

import pytest

from app.cli.service_log import FILE_BYTES, FILES, ServiceLogFile


@pytest.fixture
def open_log(tmp_path):
    """A logger with nothing but the file in a folder."""
    logger = logging.Logger("osf.test")
    handler = ServiceLogFile(tmp_path / "logs" / "service.log")
    logger.addHandler(handler)
    yield logger
    handler.close()


def test_files_are_replaced_in_turn_and_never_grow_beyond_their_share(open_log, tmp_path):
    line = "x" * 10_000
    for number in range(FILE_BYTES * (FILES + 2) // len(line)):
        open_log.warning("%d %s", number, line)
    files = sorted((tmp_path / "logs").iterdir())
    assert [file.name for file in files] == ["service.log", *(f"service.log.{n}" for n in range(1, FILES))]
    assert all(file.stat().st_size <= FILE_BYTES for file in files)
    assert files[0].read_text().splitlines()[-1].startswith(str(number))


def test_a_disk_that_is_full_is_told_once_and_tried_again(open_log, tmp_path, capfd):
    path = tmp_path / "logs" / "service.log"
    os.symlink("/dev/full", path)
    for number in range(200):
        open_log.error("lost %d", number)
    err = capfd.readouterr().err
    assert err == f"{path} cannot be written (No space left on device); logging here alone.\n"
    path.unlink()
    open_log.error("there is room again")
    assert path.read_text() == "there is room again\n"
    assert capfd.readouterr().err == ""


def test_a_folder_that_cannot_be_made_is_told_once(tmp_path, capfd):
    (tmp_path / "logs").write_text("in the way")
    logger = logging.Logger("osf.test")
    logger.addHandler(ServiceLogFile(tmp_path / "logs" / "service.log"))
    for number in range(3):
        logger.error("lost %d", number)
    assert capfd.readouterr().err.count("cannot be written") == 1
