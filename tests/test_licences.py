"""Which licences come with what pip installs: the table in the documents holds, and nobody gets the GPL unasked."""

import platform
import re
import runpy
import sys
from importlib.metadata import distribution

import pytest

from tests.test_layers import ROOT

LICENCES = runpy.run_path(str(ROOT / ".ci" / "licences.py"))


def test_no_package_that_comes_unasked_is_under_the_gpl():
    for name in LICENCES["closure"]():
        package = distribution(name)
        assert not re.search(r"GPL(?!.*GCC-exception)", LICENCES["licence_of"](package).replace("LGPL", "")), name
        for file in package.files or ():  # metadata may tell of a wrapper alone
            assert not re.search(r"libx26[45]|(^|/)ffmpeg[^/]*(?<!\.py)(?<!\.pyc)$", str(file)), f"{name} brings {file}"


@pytest.mark.skipif(
    (sys.version_info[:2], sys.platform, platform.machine()) != ((3, 11), "linux", "x86_64"),
    reason="other packages are needed elsewhere",
)
def test_the_table_in_the_documents_is_what_is_installed():
    table = (ROOT / "docs" / "reference" / "licences.md").read_text()
    assert table == LICENCES["table"](), "python .ci/licences.py > docs/reference/licences.md makes it anew"
