import itertools

from hypothesis import given
from hypothesis import strategies as st

from osfcore.dynamics.train import has_held_out_pair, is_for_validation, is_held_out_pair
from osfcore.fields.field_library import FieldLibrary

NAMES = FieldLibrary(None).names()
PAIRS = list(itertools.combinations(NAMES, 2))


def test_about_one_pair_in_sixteen_never_meets():
    held = [pair for pair in PAIRS if is_held_out_pair(*pair)]
    assert 5 <= len(held) <= 20  # of 190
    assert len({name for pair in held for name in pair}) >= 6


@given(a=st.text(max_size=8), b=st.text(max_size=8))
def test_who_is_named_first_does_not_matter(a, b):
    assert is_held_out_pair(a, b) == is_held_out_pair(b, a) == has_held_out_pair([a, b])


@given(names=st.lists(st.sampled_from(NAMES), unique=True, max_size=6))
def test_a_scene_is_held_out_for_any_of_its_pairs(names):
    assert has_held_out_pair(names) == any(is_held_out_pair(a, b) for a in names for b in names if a < b)


def test_one_object_alone_is_never_held_out():
    assert not has_held_out_pair([])
    assert not any(has_held_out_pair([name]) for name in NAMES)


def test_one_episode_in_twelve_is_kept_to_stop_by():
    assert sum(map(is_for_validation, range(1200))) == 100
