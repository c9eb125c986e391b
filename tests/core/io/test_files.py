import json
import os
import struct
import threading
from concurrent.futures import ThreadPoolExecutor, wait
from pathlib import Path

import pytest

from osfcore.errors import CannotWrite, CorruptFile, InvalidInput
from osfcore.io.files import (
    MAX_JSON_BYTES,
    file_at_once,
    folder_at_once,
    is_text,
    read_json,
    reading_png,
    write_atomically,
    write_json,
)


def test_a_place_that_is_a_file_is_told(tmp_path):
    (tmp_path / "file").write_text("")
    with pytest.raises(CannotWrite, match="file"):
        write_atomically(tmp_path / "file" / "a.safetensors", b"")


def test_json_is_written_whole_and_read_again(tmp_path):
    write_json(tmp_path / "a.json", {"psnr": 30.5})
    assert json.loads((tmp_path / "a.json").read_text()) == {"psnr": 30.5}
    assert read_json(tmp_path / "a.json", lambda data: data) == {"psnr": 30.5}
    assert [path.name for path in tmp_path.iterdir()] == ["a.json"]


def test_a_full_disk_leaves_the_older_file(tmp_path, monkeypatch):
    path = tmp_path / "a.json"
    path.write_text("older")

    def full(self, data):
        raise OSError(28, "No space left on device")

    monkeypatch.setattr("pathlib.Path.write_bytes", full)
    with pytest.raises(CannotWrite, match="No space left"):
        write_json(path, {})
    assert path.read_text() == "older"
    assert [p.name for p in tmp_path.iterdir()] == ["a.json"]


def test_many_threads_write_one_file_and_readers_see_it_whole(tmp_path):
    path, size = tmp_path / "a.bin", 200_000
    write_atomically(path, bytes(size))
    writers, torn, is_over = 8, [], threading.Event()

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


@pytest.mark.parametrize("error", [OSError(28, "No space left on device"), ZeroDivisionError()])
def test_nothing_of_a_file_is_left_that_could_not_be_filled(tmp_path, error):
    path = tmp_path / "a.zip"

    def fill():
        with file_at_once(path) as partial:
            partial.write_bytes(b"half")
            raise error

    with pytest.raises(CannotWrite if isinstance(error, OSError) else ZeroDivisionError):
        fill()
    assert list(path.parent.iterdir()) == []


@pytest.mark.parametrize(
    ("content", "words"),
    [
        (b"\xff\xfe\x00", "not a text file"),
        (b'{"a": [', "not valid JSON .line 1"),
        (b"1" * 5000, "not valid JSON"),
        (b"[" * 100_000, "nested too deeply"),
        (b" " * (MAX_JSON_BYTES + 1), "larger than 16 MB"),
    ],
    ids=["binary", "cut", "digits", "deep", "large"],
)
def test_what_is_no_json_is_told(tmp_path, content, words):
    path = tmp_path / "a.json"
    path.write_bytes(content)
    with pytest.raises(CorruptFile, match=f"a.json cannot be used: it is {words}"):
        read_json(path, lambda data: data)


def test_what_a_parser_says_is_told_with_the_file_once(tmp_path):
    def refuse(data):
        raise InvalidInput("number", data, "2")

    def refuse_another(data):
        raise CorruptFile("b.png", "it is broken")

    path = tmp_path / "a.json"
    path.write_text("1")
    with pytest.raises(CorruptFile, match=r"a.json cannot be used: number is 1, but it must be 2\.$"):
        read_json(path, refuse)
    with pytest.raises(CorruptFile, match=r"^b.png cannot be used: it is broken\.$"):
        read_json(path, refuse_another)
    with pytest.raises(CorruptFile, match="No such file"):
        read_json(tmp_path / "b.json", refuse)


def test_halves_of_characters_are_no_text():
    assert is_text("Dose Käse 食")
    assert not is_text("\ud800.png")


@pytest.mark.parametrize("error", [OSError("x"), SyntaxError("x"), ValueError("x"), EOFError("x"), struct.error("x")])
def test_whatever_a_png_raises_becomes_one_sentence(error):
    with pytest.raises(CorruptFile, match="it is damaged"), reading_png(Path("a.png"), "it is damaged"):
        raise error
    with pytest.raises(CorruptFile, match="16 bits"), reading_png(Path("a.png"), "it is damaged"):
        raise CorruptFile("a.png", "16 bits")


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
