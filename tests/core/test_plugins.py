import pytest

from osfcore.errors import InvalidInput, OsfError, UnknownName
from osfcore.plugins import BrokenPlugin, PartKind, part_factory, part_names

COST = PartKind("cost", ("__call__",))
PLANNER = PartKind("planner", ("plan", "reset"))
OWN = {"pose": lambda given: lambda: f"ours of {given}"}
SOURCE = """
from osfcore.errors import InvalidInput

def taste(given):
    return lambda: f"theirs of {given}"

def careless(given):
    return 1 / 0

def strict(given):
    raise InvalidInput("taste", given, "sweet")

def bare(given):
    return object()
"""


@pytest.fixture
def installed(tmp_path, monkeypatch):
    """Puts a package on the path, as pip leaves it."""

    def install(package, group, **names):
        module, info = package.replace("-", "_"), tmp_path / f"{package}-1.0.dist-info"
        info.mkdir()
        (info / "METADATA").write_text(f"Metadata-Version: 2.1\nName: {package}\nVersion: 1.0\n")
        lines = [f"{name} = {module}:{target}" for name, target in names.items()]
        (info / "entry_points.txt").write_text("\n".join([f"[{group}]", *lines]))
        (tmp_path / f"{module}.py").write_text(SOURCE)
        monkeypatch.syspath_prepend(tmp_path)

    return install


def test_a_part_of_another_package_is_made_as_ours_are(installed):
    installed("tasty-parts", COST.group, taste="taste")
    assert part_names(COST, OWN) == ("pose", "taste")
    assert part_factory(COST, "taste", OWN)("that")() == "theirs of that"
    assert part_factory(COST, "pose", OWN)("that")() == "ours of that"
    assert part_names(PLANNER, {}) == ()


def test_names_of_ours_cannot_be_taken(installed):
    installed("greedy-parts", COST.group, pose="taste")
    assert part_factory(COST, "pose", OWN)("that")() == "ours of that"
    assert part_names(COST, OWN) == ("pose",)


def test_an_unknown_name_is_answered_with_all_there_are(installed):
    installed("tasteful-parts", COST.group, taste="taste")
    with pytest.raises(UnknownName, match="no cost named 'tast'; did you mean taste\\? known: pose, taste"):
        part_factory(COST, "tast", OWN)


@pytest.mark.parametrize(
    ("target", "words"),
    [("gone", "gone"), ("careless", "ZeroDivisionError: division by zero"), ("bare", "it has no plan, reset")],
)
def test_a_broken_part_says_whose_it_is(installed, target, words):
    package = f"broken-{target}"
    installed(package, PLANNER.group, bad=target)
    with pytest.raises(BrokenPlugin) as error:
        part_factory(PLANNER, "bad", {})("that")
    assert str(error.value).startswith(f"The planner 'bad' of the package {package} cannot be used: ")
    assert words in str(error.value)


def test_a_package_that_cannot_be_imported_says_so(installed, tmp_path):
    installed("halved-parts", COST.group, half="taste")
    (tmp_path / "halved_parts.py").write_text("import a_package_that_nobody_has")
    with pytest.raises(BrokenPlugin, match="halved-parts cannot be used: .*a_package_that_nobody_has"):
        part_factory(COST, "half", OWN)


def test_what_a_part_says_of_an_input_is_told_as_it_is(installed):
    installed("strict-parts", COST.group, strict="strict")
    with pytest.raises(InvalidInput, match="taste is sour, but it must be sweet"):
        part_factory(COST, "strict", OWN)("sour")


def test_a_name_that_two_packages_offer_is_refused(installed):
    installed("first-parts", COST.group, same="taste")
    installed("second-parts", COST.group, same="taste")
    with pytest.raises(OsfError, match="first-parts and second-parts cannot be used: both offer this name"):
        part_factory(COST, "same", OWN)
