"""Copies of parsed JSON with one entry changed."""

import copy


def edited(data, path, value):
    """A copy of parsed JSON with one entry set, or removed where the value is `...`."""
    data = copy.deepcopy(data)
    at = data
    for key in path[:-1]:
        at = at[key]
    if value is ...:
        del at[path[-1]]
    else:
        at[path[-1]] = value
    return data
