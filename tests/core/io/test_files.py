import os
import struct
import threading
from concurrent.futures import ThreadPoolExecutor, wait
from pathlib import Path
from unittest.mock import Mock

import pytest

from osfcore.errors import CannotWrite, CorruptFile, InvalidInput
from osfcore.io.files import (
    MAX_JSON_BYTES,
    file_at_once,
    folder_at_once,
    read_json,
    reading_png,
    write_atomically,
    write_json,
)
from tests.support.errors import about


@pytest.mark.parametrize("error", [OSError(28, "No space left on device"), ZeroDivisionError()])
def test_a_file_that_cannot_be_filled_leaves_the_older_one(tmp_path, error):
    path = tmp_path / "a.zip"
    path.write_text("older")

    def fill():
        with file_at_once(path) as partial:
            partial.write_bytes(b"half")
            raise error

    with pytest.raises(CannotWrite if isinstance(error, OSError) else ZeroDivisionError):
        fill()
    with pytest.raises(CannotWrite):
        write_atomically(path / "b.json", b"")
    assert path.read_text() == "older"
    write_json(path, {"psnr": 30.5})
    assert read_json(path, lambda data: data) == {"psnr": 30.5}
    assert list(tmp_path.iterdir()) == [path]


def test_many_threads_write_one_file_and_readers_see_it_whole(tmp_path):
    path, size = tmp_path / "a.bin", 200_000
    write_atomically(path, bytes(size))
    writers, torn, is_over = 4, [], threading.Event()

    def write(number):
        for _ in range(10):
            write_atomically(path, bytes([number]) * size)

    def read():
        while not is_over.is_set():
            data = path.read_bytes()
            if data != data[:1] * size:
                torn.append(len(data))

    with ThreadPoolExecutor(writers + 2) as pool:
        readers = [pool.submit(read) for _ in range(2)]
        written = [pool.submit(write, number) for number in range(writers)]
        wait(written)
        is_over.set()
        for done in (*written, *readers):
            done.result()
    assert torn == []
    assert [p.name for p in tmp_path.iterdir()] == ["a.bin"]


@pytest.mark.parametrize("umask", [0o022, 0o027, 0o077])
def test_files_and_folders_have_the_rights_that_plain_writing_gives(tmp_path, umask):
    before = os.umask(umask)
    try:
        (tmp_path / "plain").write_bytes(b"")
        write_atomically(tmp_path / "atomic", b"")
        (tmp_path / "plain folder").mkdir()
        with folder_at_once(tmp_path / "folder"):
            pass
    finally:
        os.umask(before)
    rights = {path.name: path.stat().st_mode for path in tmp_path.iterdir()}
    assert rights["atomic"] == rights["plain"]
    assert rights["folder"] == rights["plain folder"]


@pytest.mark.parametrize(
    "content",
    [b"\xff\xfe\x00", b'{"a": [', b"1" * 5000, b"[" * 100_000, b" " * (MAX_JSON_BYTES + 1), None],
    ids=["binary", "cut", "digits", "deep", "large", "missing"],
)
def test_what_is_no_json_is_refused(tmp_path, content):
    path = tmp_path / "a.json"
    if content is not None:
        path.write_bytes(content)
    with pytest.raises(CorruptFile, check=about("a.json")):
        read_json(path, lambda data: data)


def test_the_error_of_a_parser_is_given_with_the_file_once(tmp_path):
    path = tmp_path / "a.json"
    path.write_text("1")
    for error, named in ((InvalidInput("number", 1, "2"), str(path)), (CorruptFile("b.png", "it is broken"), "b.png")):
        with pytest.raises(CorruptFile) as caught:
            read_json(path, Mock(side_effect=error))
        assert caught.value.path == named


@pytest.mark.parametrize("error", [OSError("x"), SyntaxError("x"), ValueError("x"), EOFError("x"), struct.error("x")])
def test_whatever_a_png_raises_is_a_corrupt_file(error):
    for raised, reason in ((error, "damaged"), (CorruptFile("a.png", "16 bits"), "16 bits")):
        with pytest.raises(CorruptFile, check=about(reason)), reading_png(Path("a.png"), "damaged"):
            raise raised


def test_a_folder_appears_whole_or_not_at_all(tmp_path):
    out = tmp_path / "new" / "folder"
    with folder_at_once(out) as partial:
        (partial / "a").write_text("1")
        assert not out.exists()
    assert (out / "a").read_text() == "1"
    with pytest.raises(ZeroDivisionError), folder_at_once(tmp_path / "other") as partial:
        (partial / "a").write_text(str(1 / 0))
    assert [path.name for path in tmp_path.iterdir()] == ["new"]
    with pytest.raises(CannotWrite), folder_at_once(out):
        pass  # it is not empty
    assert [path.name for path in out.parent.iterdir()] == ["folder"]
