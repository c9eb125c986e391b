import pytest

from osfcore.errors import InvalidInput, UnknownName
from osfcore.plugins import BrokenPlugin, PartKind, part_factory, part_names
from tests.support.errors import about

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

    def install(package, kind, source=SOURCE, **names):
        module, info = package.replace("-", "_"), tmp_path / f"{package}-1.0.dist-info"
        info.mkdir()
        (info / "METADATA").write_text(f"Metadata-Version: 2.1\nName: {package}\nVersion: 1.0\n")
        lines = [f"{name} = {module}:{target}" for name, target in names.items()]
        (info / "entry_points.txt").write_text("\n".join([f"[{kind.group}]", *lines]))
        (tmp_path / f"{module}.py").write_text(source)
        monkeypatch.syspath_prepend(tmp_path)

    return install


def test_parts_of_other_packages_are_made_as_ours_are_and_cannot_take_our_names(installed):
    installed("tasty-parts", COST, taste="taste", pose="taste")
    assert part_names(COST, OWN) == ("pose", "taste")
    assert part_factory(COST, "taste", OWN)("that")() == "theirs of that"
    assert part_factory(COST, "pose", OWN)("that")() == "ours of that"
    assert part_names(PLANNER, {}) == ()
    with pytest.raises(UnknownName, check=about("tast")):
        part_factory(COST, "tast", OWN)


@pytest.mark.parametrize(
    ("target", "source", "reason"),
    [
        ("gone", SOURCE, "gone"),
        ("careless", SOURCE, "ZeroDivisionError: division by zero"),
        ("bare", SOURCE, "plan, reset"),
        ("lost", "import a_package_that_nobody_has", "a_package_that_nobody_has"),
    ],
)
def test_a_broken_part_names_its_package(installed, target, source, reason):
    installed(f"broken-{target}", PLANNER, source, bad=target)
    with pytest.raises(BrokenPlugin, check=about(reason)) as error:
        part_factory(PLANNER, "bad", {})("that")
    assert (error.value.name, error.value.packages) == ("bad", f"broken-{target}")


def test_errors_of_inputs_pass_and_a_name_of_two_packages_is_refused(installed):
    installed("first-parts", COST, same="taste", strict="strict")
    installed("second-parts", COST, same="taste")
    with pytest.raises(InvalidInput, check=about("taste")):
        part_factory(COST, "strict", OWN)("sour")
    with pytest.raises(BrokenPlugin, check=about("first-parts and second-parts")):
        part_factory(COST, "same", OWN)
