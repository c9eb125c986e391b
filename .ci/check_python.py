"""Say in one sentence when this Python cannot install the packages, before pip says it in a hundred lines."""

import platform
import shutil
import sys


def main():
    found = "{}.{}".format(*sys.version_info)
    if sys.version_info < (3, 11):
        return "this is Python {}, but 3.11 is needed; name one with 'make PYTHON=/path/to/python3.11'".format(found)
    has_wheel = sys.version_info[:2] == (3, 11) and platform.machine() == "x86_64"
    if not has_wheel and not (shutil.which("c++") or shutil.which("g++")):
        return (
            "PyBullet has ready-made packages for Python 3.11 on x86-64 only, and there is no C++ compiler to build it "
            "for Python {} on {}; name a Python 3.11 with 'make PYTHON=/path/to/python3.11', or install a compiler"
        ).format(found, platform.machine())
    return None


if __name__ == "__main__":
    problem = main()
    if problem:
        sys.exit("make: " + problem)
