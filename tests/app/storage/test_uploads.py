import asyncio
import os
import threading
import time

import pytest

from app.storage.database import CannotStore
from app.storage.uploads import Examiner, UploadNotStored, UploadRefused, save
from osfcore.errors import CannotWrite, CorruptFile
from tests.app.conftest import until


def names(folder):
    return {f"{folder}/": ""}


def examined(look, folder):
    return asyncio.run(Examiner(look, "drawing", names).examine(folder))


def size_of(folder):
    return len((folder / "upload").read_bytes())


def refuse(folder):
    raise CorruptFile(folder / "upload", "it is a drawing of nothing")


def fill_the_disk(folder):
    raise CannotWrite(folder, "No space left on device")


def fail(folder):
    raise RuntimeError("secret")


def devour(folder):
    raise MemoryError


def devour_truly(folder):
    return len(bytearray(8 << 30))


def die(folder):
    os._exit(3)


def dawdle(folder):
    (folder / "started").touch()
    time.sleep(60)


async def chunks(*parts):
    for part in parts:
        yield part


@pytest.mark.slow
def test_what_is_sent_in_pieces_is_there_as_a_whole(tmp_path):
    parts = [bytes([n]) * 400_000 for n in range(5)]
    asyncio.run(save(chunks(*parts), tmp_path / "new" / "upload"))
    assert (tmp_path / "new" / "upload").read_bytes() == b"".join(parts)
    assert examined(size_of, tmp_path / "new") == 2_000_000


def test_a_place_that_cannot_be_written_is_told(tmp_path):
    (tmp_path / "file").write_text("")
    with pytest.raises(CannotStore):
        asyncio.run(save(chunks(b"x"), tmp_path / "file" / "new" / "upload"))


@pytest.mark.slow
@pytest.mark.parametrize(
    ("look", "words", "kind"),
    [
        (refuse, "^upload cannot be used: it is a drawing of nothing.$", UploadRefused),
        (fill_the_disk, "No space left", UploadNotStored),
        (fail, r"failed \(RuntimeError\)", UploadRefused),
        (devour, "ran out of memory", UploadRefused),
        (devour_truly, "looked at the drawing ran out of memory; take fewer or smaller images", UploadRefused),
        (die, "ended unexpectedly", UploadRefused),
    ],
)
def test_what_cannot_be_used_is_refused_in_one_sentence(tmp_path, look, words, kind):
    with pytest.raises(UploadRefused, match=words) as refusal:
        examined(look, tmp_path)
    assert type(refusal.value) is kind
    assert "secret" not in str(refusal.value)


@pytest.mark.slow
def test_stopping_ends_a_look(tmp_path):
    examiner, outcome = Examiner(dawdle, "drawing", names), []

    def look():
        try:
            asyncio.run(examiner.examine(tmp_path))
        except UploadRefused as error:
            outcome.append(error)

    thread = threading.Thread(target=look)
    thread.start()
    until(lambda: (tmp_path / "started").exists())
    examiner.stop()
    thread.join(10)
    assert "ended unexpectedly" in str(outcome[0])
    with pytest.raises(UploadRefused, match="stopping"):
        asyncio.run(examiner.examine(tmp_path))
