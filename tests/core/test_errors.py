import pytest

from osfcore import errors

SENTENCES = [
    errors.InvalidInput("light elevation [deg]", 3, "at least 5"),
    errors.UnknownName("object", "teapot", ["b", "a"]),
    errors.MissingAssets(["bowl"]),
    errors.OverlappingObjects("mug", "bowl", 0.0123),
    errors.NoRoom(["a", "b"], 60),
    errors.CorruptFile("file.obj", "it has no faces"),
    errors.FetchFailed("The wheel", "there is no network"),
    errors.CannotWrite("Sets", "the disk is full"),
    errors.WorkerDied("collecting pushes"),
]


@pytest.mark.parametrize("error", SENTENCES, ids=lambda e: type(e).__name__)
def test_every_error_is_a_sentence_on_one_line(error):
    assert isinstance(error, errors.OsfError)
    text = str(error)
    assert text[0].isupper() or text.split(maxsplit=1)[0] in {"light", "mug", "file.obj"}
    assert text.endswith(".")
    assert "\n" not in text


def test_sentences_carry_the_facts():
    assert "a, b" in str(SENTENCES[1])
    assert "12 mm" in str(SENTENCES[3])
    assert "at least 5" in str(SENTENCES[0])


def test_sentences_stay_on_one_short_line_whatever_the_values_hold():
    nasty = "a\nb\x1b[31m\udc80" + 10_000 * "x"
    for error in (
        errors.InvalidInput("name", nasty, "short"),
        errors.UnknownName("field", nasty, [nasty]),
        errors.CorruptFile(nasty, nasty),
    ):
        text = str(error)
        assert text.isprintable()
        assert len(text) < 2100
        assert text.endswith(".")
        text.encode()


def test_values_are_cut_in_the_middle():
    text = errors.shown("start" + 1000 * "-" + "end\t")
    assert len(text) < 110
    assert text.startswith("start")
    assert text.endswith("end\\t")
    assert errors.shown("mug.png") == "mug.png"


def test_names_that_may_have_been_meant_are_asked_for():
    known = ["025_mug", "024_bowl", "006_mustard_bottle"]
    assert "named 'mug'; did you mean 025_mug? known: " in str(errors.UnknownName("object", "mug", known))
    assert "did you mean 006_mustard_bottle?" in str(errors.UnknownName("object", "006_mustrad_botle", iter(known)))
    for name in ("", "teapot", 10_000 * "x"):
        assert "did you mean" not in str(errors.UnknownName("object", name, known))
