"""Say in one sentence when this Python cannot install the packages, before pip says it in a hundred lines."""

import sys


def main():
    if sys.version_info < (3, 11):
        found = "{}.{}".format(*sys.version_info)
        return "this is Python {}, but 3.11 is needed; name one with 'make PYTHON=/path/to/python3.11'".format(found)
    return None


if __name__ == "__main__":
    problem = main()
    if problem:
        sys.exit("make: " + problem)
