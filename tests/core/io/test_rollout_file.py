import json

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from osfcore.errors import CannotWrite, CorruptFile, OsfError
from osfcore.geometry.rollouts import Rollouts
from osfcore.io.scene_file import actions_from_json, read_actions, rollouts_from_json, rollouts_to_json, write_rollouts

GOOD = {"actions": [[[0.1, -0.2, 0.0], [0.3, 0.0, 0.0]]], "step_s": 0.2}


def example(seed: int = 0) -> Rollouts:
    rng = np.random.default_rng(seed)
    return Rollouts(
        ("box", "can"), rng.normal(size=(3, 5, 2, 3)), rng.normal(size=(3, 5, 2, 4)), rng.normal(size=(3, 5, 3))
    )


@given(count=st.integers(1, 4), horizon=st.integers(1, 6), seed=st.integers(0, 10**6))
def test_actions_survive_their_file(tmp_path_factory, count, horizon, seed):
    actions = np.random.default_rng(seed).uniform(-0.3, 0.3, (count, horizon, 3)) * [1, 1, 0]
    path = tmp_path_factory.mktemp("actions") / "actions.json"
    path.write_text(json.dumps({"actions": actions.tolist()}))
    np.testing.assert_array_equal(read_actions(path), actions)


def test_the_length_of_a_step_may_be_told():
    np.testing.assert_array_equal(actions_from_json(GOOD), GOOD["actions"])


def test_rollouts_survive_their_file_to_the_nanometre(tmp_path):
    rollouts = example()
    write_rollouts(tmp_path / "rollouts.json", rollouts)
    back = json.loads((tmp_path / "rollouts.json").read_text(), parse_constant=pytest.fail)
    assert set(back) == {"names", "positions", "quaternions", "pusher", "step_s"}
    assert back["names"] == ["box", "can"]
    assert back["step_s"] == 0.2
    for key in ("positions", "quaternions", "pusher"):
        np.testing.assert_allclose(back[key], getattr(rollouts, key), atol=1e-9, rtol=0)
    assert rollouts_to_json(rollouts) == back


@pytest.mark.parametrize(
    ("content", "words"),
    [
        ({}, "'actions' of the actions file is missing"),
        ({"step_s": 0.2}, "'actions' of the actions file is missing"),
        (GOOD | {"step_s": 0.1}, "step_s is 0.1, but it must be 0.2"),
        (GOOD | {"step_s": "0.2"}, "step_s is '0.2'"),
        (GOOD | {"step_s": None}, "step_s is None"),
        (GOOD | {"step_s": True}, "step_s is True"),
        (GOOD | {"step_s": float("nan")}, "step_s is nan"),
        (GOOD | {"actions": [[[0.31, 0, 0]]]}, "action 0 of sequence 0"),
        (GOOD | {"actions": [[[float("nan"), 0, 0]]]}, "action 0 of sequence 0"),
        (GOOD | {"actions": [[[0.1, 0, 0]], []]}, "actions"),
        (GOOD | {"actions": [[0.1, 0, 0]]}, "shape of the actions"),
        (GOOD | {"actions": []}, "shape of the actions"),
        (GOOD | {"actions": "north"}, "actions"),
        (GOOD | {"actions": None}, "actions"),
        ([], "actions file is"),
        ("text", "actions file is"),
    ],
)
def test_mistakes_are_told_with_the_file_that_has_them(tmp_path, content, words):
    path = tmp_path / "actions.json"
    path.write_text(json.dumps(content))
    with pytest.raises(CorruptFile, match=f"actions.json cannot be used: .*{words}") as caught:
        read_actions(path)
    assert len(str(caught.value)) < 600


def test_rollouts_are_read_as_they_were_written():
    given = example()
    read = rollouts_from_json(json.loads(json.dumps(rollouts_to_json(given))))
    assert read.names == given.names
    for part in ("positions", "quaternions", "pusher"):
        np.testing.assert_allclose(getattr(read, part), getattr(given, part), atol=1e-9)
    with pytest.raises(OsfError, match="positions"):
        rollouts_from_json({**rollouts_to_json(given), "positions": "somewhere"})


@pytest.mark.parametrize("share", [0.0, 0.3, 0.6, 0.95])
def test_files_cut_short_are_told(tmp_path, share):
    path, text = tmp_path / "actions.json", json.dumps(GOOD)
    path.write_text(text[: int(share * len(text))])
    with pytest.raises(CorruptFile, match="not valid JSON"):
        read_actions(path)


def test_files_that_are_not_there_or_no_text_or_cannot_be_written_are_told(tmp_path):
    with pytest.raises(CorruptFile, match="No such file"):
        read_actions(tmp_path / "actions.json")
    (tmp_path / "file").write_bytes(b"\xff\xfe\x00")
    with pytest.raises(CorruptFile, match="not a text file"):
        read_actions(tmp_path / "file")
    with pytest.raises(CannotWrite):
        write_rollouts(tmp_path / "file" / "rollouts.json", example())


values = st.recursive(
    st.none() | st.booleans() | st.floats(allow_nan=True) | st.text(max_size=5),
    lambda inner: st.lists(inner, max_size=3) | st.dictionaries(st.text(max_size=5), inner, max_size=3),
    max_leaves=8,
)


@given(key=st.sampled_from(["actions", "step_s"]), value=values)
def test_whatever_comes_it_is_actions_or_a_clear_error(key, value):
    try:
        actions_from_json({**GOOD, key: value})
    except OsfError as error:
        assert len(str(error)) < 600
