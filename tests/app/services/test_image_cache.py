from app.services.image_cache import ImageCache


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
