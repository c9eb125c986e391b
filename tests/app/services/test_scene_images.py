import asyncio

import pytest

from app.processes.messages.scene_messages import TakeImage
from app.services.scenes import ImageCache, SceneImages
from osfcore.errors import OsfError, UnknownName
from tests.support.errors import about

SHOT = TakeImage("s", "0", 64)


class Stage:
    """A scene with a revision, and a camera that takes its time."""

    def __init__(self):
        self.revision, self.taken = 1, 0
        self.is_open = asyncio.Event()
        self.is_open.set()
        self.error = None

    def revision_of(self, scene):
        if scene != "s":
            raise UnknownName("scene", scene, ["s"])
        return self.revision

    async def take(self, command):
        self.taken += 1
        number = self.taken
        await self.is_open.wait()
        if self.error is not None:
            raise self.error
        return f"{command.camera} {number}".encode()


def played(play):
    """Runs a scene of a test in an event loop."""

    async def run():
        stage = Stage()
        await play(stage, SceneImages(10_000, stage.revision_of, stage.take))

    asyncio.run(run())


def test_an_image_is_kept_until_the_scene_changes():
    async def play(stage, images):
        assert await images.image(SHOT) == await images.image(SHOT) == b"0 1"
        stage.revision = 2
        assert await images.image(SHOT) == b"0 2"
        assert await images.image(TakeImage("s", "1", 64)) == b"1 3"

    played(play)


def test_many_who_ask_at_once_get_the_same_image():
    async def play(stage, images):
        stage.is_open.clear()
        asking = [asyncio.ensure_future(images.image(SHOT)) for _ in range(5)]
        await asyncio.sleep(0)
        asking[0].cancel()  # whoever asked first leaves
        stage.is_open.set()
        assert await asyncio.gather(*asking[1:]) == [b"0 1"] * 4
        assert stage.taken == 1

    played(play)


def test_what_shows_a_later_state_is_given_out_but_not_kept():
    async def play(stage, images):
        stage.is_open.clear()
        asking = asyncio.ensure_future(images.image(SHOT))
        await asyncio.sleep(0)
        stage.revision = 2
        stage.is_open.set()
        assert await asking == b"0 1"
        stage.revision = 1
        assert await images.image(SHOT) == b"0 2"

    played(play)


def test_an_image_that_could_not_be_made_is_tried_again():
    async def play(stage, images):
        stage.error = OsfError("No.")
        with pytest.raises(OsfError, match="No"):
            await images.image(SHOT)
        stage.error = None
        assert await images.image(SHOT) == b"0 2"

    played(play)


def test_an_unknown_scene_is_told():
    async def play(stage, images):
        with pytest.raises(UnknownName, check=about("t")):
            await images.image(TakeImage("t", "0", 64))
        assert stage.taken == 0

    played(play)


def test_what_was_asked_for_the_longest_time_ago_goes_first():
    cache = ImageCache(10)
    cache.put("a", b"12345")
    cache.put("b", b"12345")
    assert cache.get("a") == b"12345"
    cache.put("c", b"1")
    assert (cache.get("a"), cache.get("b"), cache.get("c")) == (b"12345", None, b"1")


def test_a_new_image_takes_the_place_of_the_old_one():
    cache = ImageCache(10)
    cache.put("a", b"123456789")
    cache.put("a", b"12")
    cache.put("b", b"12345678")
    assert cache.get("a") == b"12"


def test_too_large_an_image_is_not_kept():
    cache = ImageCache(3)
    cache.put("a", b"1234")
    assert cache.get("a") is None
