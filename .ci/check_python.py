"""Say in one sentence when this Python cannot install the packages, before pip says it in a hundred lines."""

import platform
import shutil
import sys


def main():
    found = "{}.{}".format(*sys.version_info)
    if sys.version_info < (3, 11):
        return "this is Python {}, but 3.11 is needed; name one with 'make PYTHON=/path/to/python3.11'".format(found)
    if sys.version_info[:2] > (3, 11):
        return (
            "this is Python {}, for which there is no PyBullet, the simulator of the page; name a Python 3.11 with "
            "'make PYTHON=/path/to/python3.11', or do without it: pip install ."
        ).format(found)
    if platform.machine() != "x86_64" and not (shutil.which("c++") or shutil.which("g++")):
        return (
            "PyBullet has ready-made packages for x86-64 only, and there is no C++ compiler to build it on {}; "
            "install a compiler"
        ).format(platform.machine())
    return None


if __name__ == "__main__":
    problem = main()
    if problem:
        sys.exit("make: " + problem)
