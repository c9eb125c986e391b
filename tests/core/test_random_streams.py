import itertools
import re
from pathlib import Path

import numpy as np
from hypothesis import given
from hypothesis import strategies as st

from osfcore.random_streams import Stream, stream_rng, stream_seed

ROOT = Path(__file__).parents[2]
# What has one stream alone: a world's own reset, and trainings.
KEYLESS = (
    "osfcore/random_streams.py",
    "osfcore/world/tabletop.py",
    "osfcore/dynamics/train.py",
    "osfcore/fields/train_",
    "osfcore/paper/train_",
)
keys = st.tuples(st.sampled_from(list(Stream)), st.lists(st.integers(0, 3), max_size=3).map(tuple))


def begins(seed, stream, numbers):
    return tuple(stream_rng(seed, stream, *numbers).integers(1 << 62, size=2))


@given(seed=st.integers(0, 2**63 - 1), one=keys, other=keys)
def test_two_purposes_never_share_a_stream(seed, one, other):
    assert (begins(seed, *one) == begins(seed, *other)) == (one == other)


def test_no_two_tags_share_a_stream_whatever_follows_them():
    numbers = [(), (0,), (1,), (0, 0), (0, 1), (1, 0), (0, 0, 0)]
    drawn = [begins(0, stream, n) for stream, n in itertools.product(Stream, numbers)]
    drawn.append(tuple(np.random.default_rng(0).integers(1 << 62, size=2)))  # of a world's own reset
    assert len(set(drawn)) == len(Stream) * len(numbers) + 1


def test_seeds_of_streams_fit_where_a_table_takes_a_seed():
    seeds = [stream_seed(3, Stream.COLLECTED_SCENE, index) for index in range(1000)]
    assert len(set(seeds)) == 1000
    assert 0 <= min(seeds) <= max(seeds) < 2**31


def test_nothing_is_drawn_beside_the_streams():
    found = [
        str(path.relative_to(ROOT))
        for package in ("osfcore", "app")
        for path in sorted((ROOT / package).rglob("*.py"))
        if re.search(r"^(?! *(>>>|\.\.\. )).*(default_rng\((?!\))|SeedSequence\()", path.read_text(), re.MULTILINE)
        and not str(path.relative_to(ROOT)).startswith(KEYLESS)
    ]
    assert found == []
