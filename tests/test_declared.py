"""What the packages import is declared in pyproject.toml, in the core or in an extra."""

import re
import sys
import tomllib
from importlib.metadata import packages_distributions

from tests.test_layers import IMPORTS, ROOT

UNDECLARED = {"gym-pusht"}  # comes on top without its dependencies, as `osfcore/extras.py` says


def normalized(name):
    return re.sub(r"[-_.]+", "-", name).lower()


def test_every_package_that_is_imported_is_declared():
    project = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]
    requirements = sum(project["optional-dependencies"].values(), project["dependencies"])
    declared = {normalized(re.match(r"[\w.-]+", requirement)[0]) for requirement in requirements} | UNDECLARED
    distributions = packages_distributions()
    tops = {name.partition(".")[0] for names in IMPORTS.values() for name in names}
    for top in tops - sys.stdlib_module_names - {"app", "osfcore"}:
        bring = {normalized(distribution) for distribution in distributions.get(top, [top])}
        assert bring & declared, f"{top} is imported, but none of {sorted(bring)} is declared"
