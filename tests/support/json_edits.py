"""Copies of parsed JSON with one entry changed, and JSON of any kind."""

import copy

from hypothesis import strategies as st


def json_values_with(*keys):
    """Strategy of parsed JSON whose objects have some of the keys."""
    return st.recursive(
        st.none() | st.booleans() | st.floats(allow_nan=True) | st.integers() | st.text(max_size=5),
        lambda inner: st.lists(inner, max_size=4) | st.dictionaries(st.sampled_from(keys), inner),
        max_leaves=12,
    )


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
