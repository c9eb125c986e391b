import pickle

import pytest

from osfcore import errors

NASTY = "a\nb\x1b[31m\udc80" + 10_000 * "x"


@pytest.mark.parametrize(
    "error",
    [
        errors.InvalidInput("light elevation [deg]", 3, "at least 5"),
        errors.MissingAssets(["bowl"]),
        errors.OverlappingObjects("mug", "bowl", 0.0123),
        errors.NoRoom(["a", "b"], 60),
        errors.NotThere("scene"),
        errors.FetchFailed("The wheel", "there is no network"),
        errors.CannotWrite("Sets", "the disk is full"),
        errors.WorkerDied("collecting pushes"),
        errors.InvalidInput("name", NASTY, "short"),
        errors.UnknownName("field", NASTY, [NASTY]),
        errors.CorruptFile(NASTY, NASTY),
    ],
    ids=lambda error: type(error).__name__,
)
def test_every_error_is_one_short_printable_line_and_survives_pickling(error):
    text = str(error)
    assert isinstance(error, errors.OsfError)
    assert text.endswith(".")
    assert text.isprintable()
    assert len(text) < 2100
    back = pickle.loads(pickle.dumps(error))
    assert (type(back), str(back), vars(back)) == (type(error), text, vars(error))


def test_values_are_cut_in_the_middle():
    text = errors.shown("start" + 1000 * "-" + "end\t")
    assert len(text) < 110
    assert text.startswith("start")
    assert text.endswith("end\\t")
    assert errors.shown("mug.png") == "mug.png"


def test_names_that_may_have_been_meant_are_suggested():
    known = ["025_mug", "024_bowl", "006_mustard_bottle"]
    suggested = "did you mean"
    for name, meant in (("mug", "025_mug"), ("006_mustrad_botle", "006_mustard_bottle")):
        assert f"{suggested} {meant}?" in str(errors.UnknownName("object", name, iter(known)))
    for name in ("", "teapot", 10_000 * "x"):
        assert suggested not in str(errors.UnknownName("object", name, known))


def test_seeds_are_what_every_generator_takes():
    for seed in (0, 2**63 - 1):
        assert errors.check_seed(seed) == seed
    for seed in (-1, 2**63, 10**400):
        with pytest.raises(errors.InvalidInput):
            errors.check_seed(seed)
