"""Train dynamics: training, recordings, validation."""

import json
from dataclasses import replace

import numpy as np
import pytest
import torch
from safetensors.torch import load

from osfcore.errors import CannotWrite, CorruptFile, InvalidInput
from osfcore.geometry.poses import quaternion_exp
from osfcore.paper import train_dynamics as training
from osfcore.paper.dynamics import GraphNetwork, read_network
from osfcore.paper.train_dynamics import TrainPaperDynamics, record, train_paper_dynamics, validate, windows
from tests.core.paper.scenes import BOX, CAN, KAPPAS, NAMES, episode, network, write

# Training


@pytest.fixture(scope="module")
def data(tmp_path_factory):
    """Twenty-six episodes, three of them to stop by."""
    return write(tmp_path_factory.mktemp("pushes") / "pushes.h5", [episode(seed) for seed in range(26)])


@pytest.fixture
def often(monkeypatch):
    """Measure, save and tell so often that short runs have something to tell."""
    monkeypatch.setattr(training, "_MEASURE_EVERY", 2)
    monkeypatch.setattr(training, "_REPORT_EVERY", 1)


def config(data, folder, **changes) -> TrainPaperDynamics:
    settings = {"iterations": 6, "batch": 6, "hidden": 8, **changes}
    return TrainPaperDynamics((data,), folder / "net.safetensors", device="cpu", **settings)


def told(settings: TrainPaperDynamics) -> dict:
    return json.loads(settings.out.with_suffix(".json").read_text(), parse_constant=pytest.fail)


def assert_same_weights(a, b) -> None:
    a, b = load(a.read_bytes()), load(b.read_bytes())
    assert all(torch.equal(a[name], b[name]) for name in a)


@pytest.mark.usefixtures("often")
def test_a_run_writes_a_network_and_what_is_known_of_it(data, tmp_path):
    settings = config(data, tmp_path)
    steps = list(train_paper_dynamics(settings, KAPPAS))
    assert [s.done for s in steps] == [0, 1, 2, 3, 4, 5, 6, 6]
    assert "held out" in steps[-1].note
    assert (read_network(settings.out).hidden, read_network(settings.out).names) == (8, NAMES)
    found = told(settings)
    measured = ("windows", "mm_4", "deg_4", "mean_mm_4", "constant_mm_4", "constant_deg_4")
    own = {"iterations", "seed", "device", "machine", "threads", "bytes", "episodes", "windows", "data", "command"}
    assert set(found) == {f"validation_{name}" for name in measured} | own
    assert (found["iterations"], found["episodes"], found["windows"]) == (6, 23, 23 * 6)
    assert found["bytes"] == settings.out.stat().st_size
    assert found["validation_constant_mm_4"] > 10
    assert {p.name for p in tmp_path.iterdir()} == {"net.safetensors", "net.json"}  # no checkpoint is left


def test_the_command_says_how_to_do_it_again(data, tmp_path):
    plain = TrainPaperDynamics((data,), tmp_path / "net.safetensors")
    assert plain.command == "osf train dynamics --method paper --data pushes.h5 --out net.safetensors"
    assert replace(plain, hidden=5, seed=3).command.endswith("--hidden 5 --seed 3")


@pytest.mark.usefixtures("often")
def test_an_abandoned_run_goes_on_and_ends_as_a_whole_one(data, tmp_path):
    whole, parts = config(data, tmp_path / "whole"), config(data, tmp_path / "parts")
    list(train_paper_dynamics(whole, KAPPAS))
    begun = train_paper_dynamics(parts, KAPPAS)
    for step in begun:
        if step.done == 3:
            break
    begun.close()
    assert not parts.out.exists()
    assert [s.done for s in train_paper_dynamics(parts, KAPPAS)][:2] == [0, 3]  # from the checkpoint after two
    assert_same_weights(whole.out, parts.out)


@pytest.mark.usefixtures("often")
@pytest.mark.parametrize("damage", ["other settings", "cut short", "rubbish"])
def test_a_checkpoint_that_does_not_fit_is_not_gone_on_with(data, tmp_path, damage):
    settings = config(data, tmp_path)
    begun = train_paper_dynamics(replace(settings, seed=1) if damage == "other settings" else settings, KAPPAS)
    while next(begun).done < 3:
        pass
    begun.close()
    checkpoint = settings.out.with_suffix(".checkpoint")
    content = checkpoint.read_bytes()
    if damage != "other settings":
        checkpoint.write_bytes(content[: len(content) // 2] if damage == "cut short" else b"rubbish")
    assert [s.done for s in train_paper_dynamics(settings, KAPPAS)][1] == 1


def test_training_beats_predicting_no_motion(data, tmp_path):
    settings = config(data, tmp_path, iterations=100, batch=32, hidden=16, rate=1e-2)
    list(train_paper_dynamics(settings, KAPPAS))
    found = told(settings)
    assert found["validation_mean_mm_4"] < 0.5 * found["validation_constant_mm_4"]
    assert found["validation_mm_4"] < 0.5 * found["validation_constant_mm_4"]


@pytest.mark.usefixtures("often")
def test_a_run_stops_when_nothing_gets_better(data, tmp_path):
    settings = config(data, tmp_path, iterations=50, rate=1e-9, patience=3)
    *_, before, last = train_paper_dynamics(settings, KAPPAS)
    assert before.done < 50
    assert (last.done, last.total) == (50, 50)
    assert told(settings)["iterations"] < 50


def test_the_same_seed_gives_the_same_weights_and_another_seed_others(data, tmp_path):
    for folder, seed in (("a", 0), ("b", 0), ("c", 1)):
        list(train_paper_dynamics(config(data, tmp_path / folder, iterations=2, seed=seed), KAPPAS))
    assert_same_weights(tmp_path / "a" / "net.safetensors", tmp_path / "b" / "net.safetensors")
    with pytest.raises(AssertionError):
        assert_same_weights(tmp_path / "a" / "net.safetensors", tmp_path / "c" / "net.safetensors")


@pytest.mark.parametrize(
    ("changes", "words"),
    [
        ({"iterations": 0}, "number of iterations"),
        ({"batch": 0}, "batch"),
        ({"hidden": 0}, "width"),
        ({"patience": 0}, "patience"),
        ({"rate": 0.0}, "rate of learning"),
        ({"seed": -1}, "seed"),
    ],
)
def test_numbers_out_of_range_are_told(data, tmp_path, changes, words):
    with pytest.raises(InvalidInput, match=words):
        list(train_paper_dynamics(config(data, tmp_path, **changes), KAPPAS))


def test_data_and_places_that_do_not_serve_are_told(data, tmp_path):
    good = config(data, tmp_path)
    with pytest.raises(CorruptFile):
        list(train_paper_dynamics(replace(good, data=(tmp_path / "nowhere.h5",)), KAPPAS))
    with pytest.raises(InvalidInput, match=rf"learn from is 0 \(objects without a field: {BOX}\)"):
        list(train_paper_dynamics(good, {CAN: 0.1}))
    single = write(tmp_path / "single.h5", [episode(0), *(episode(n, names=("teapot", CAN)) for n in range(1, 3))])
    with pytest.raises(InvalidInput, match="episodes to learn from is 0"):
        list(train_paper_dynamics(config(single, tmp_path), KAPPAS))
    (tmp_path / "file").write_text("")
    with pytest.raises(CannotWrite):
        list(train_paper_dynamics(replace(good, out=tmp_path / "file" / "net.safetensors"), KAPPAS))
    (tmp_path / "net.json").write_text("{}")
    with pytest.raises(InvalidInput, match=r"net\.json beside it"):
        list(train_paper_dynamics(good, KAPPAS))


# Recordings


def test_windows_are_pieces_of_their_episodes():
    episodes = [episode(0), episode(1, names=(BOX, CAN))]
    recording = record(episodes, network(), KAPPAS, 3)
    assert recording.starts.tolist() == [[e, at] for e in (0, 1) for at in range(6)]
    found = windows(recording, np.array([2, 11]))
    for row, (e, at) in enumerate(((episodes[0], 2), (episodes[1], 5))):
        np.testing.assert_allclose(found.start.position[row], e.positions[at], atol=1e-7)
        np.testing.assert_allclose(found.position[row], e.positions[at + 1 : at + 4], atol=1e-7)
        np.testing.assert_allclose(found.quaternion[row], e.quaternions[at + 1 : at + 4], atol=1e-7)
        np.testing.assert_allclose(found.pusher[row], e.pusher[at : at + 4], atol=1e-7)
        np.testing.assert_allclose(found.start.pusher[row], e.pusher[at], atol=1e-7)
        np.testing.assert_allclose(found.action[row], e.actions[at : at + 3], atol=1e-7)
        assert found.number[row].tolist() == [network().number(name) for name in e.names]
        torch.testing.assert_close(found.kappa[row], torch.tensor([KAPPAS[name] for name in e.names]))


def test_windows_in_which_something_falls_off_the_table_are_left_out():
    whole = episode(0)
    positions = whole.positions.copy()
    positions[6:, 0, 2] = -0.5
    recording = record([replace(whole, positions=positions)], network(), KAPPAS, 3)
    assert recording.starts.tolist() == [[0, 0], [0, 1], [0, 2]]
    positions[:, 0, 2] = -0.5
    with pytest.raises(InvalidInput, match="stay on the table is 0"):
        record([replace(whole, positions=positions)], network(), KAPPAS, 3)


@pytest.mark.parametrize(
    "episodes", [[episode(0), episode(1, steps=9)], [episode(0), episode(1, names=(CAN,))], [episode(0, steps=2)]]
)
def test_episodes_that_do_not_go_together_are_told(episodes):
    with pytest.raises(InvalidInput, match="steps and objects of the episodes"):
        record(episodes, network(), KAPPAS, 3)


# Validation


STILL = GraphNetwork(NAMES, 8)  # before anything is learned, nothing moves


def moving(speed: float, turn: float):
    """The first object slides along x [m an action] and turns about z [rad an action]."""
    e = episode(0)
    times = np.arange(len(e.positions))
    positions, quaternions = e.positions.copy(), e.quaternions.copy()
    positions[:, 0, 0] = speed * times
    quaternions[:, 0] = quaternion_exp(np.stack([0 * times, 0 * times, turn * times], axis=1))
    return record([replace(e, positions=positions, quaternions=quaternions)], STILL, KAPPAS, 4)


def test_predicting_no_motion_errs_by_the_motion_of_what_moves():
    found = validate(STILL, moving(0.02, 0.1))
    assert found.windows == 5
    for mm in (found.mm_4, found.mean_mm_4, found.constant_mm_4):
        assert mm == pytest.approx(80, abs=1e-3)
    for deg in (found.deg_4, found.constant_deg_4):
        assert deg == pytest.approx(np.rad2deg(0.4), abs=0.1)


def test_where_nothing_moves_everything_counts():
    found = validate(STILL, moving(0.0, 0.0))
    assert (found.windows, found.mm_4, found.constant_mm_4) == (0, pytest.approx(0, abs=1e-3), pytest.approx(0))
    assert validate(network(), moving(0.0, 0.0)).mm_4 > 1


def test_the_network_decides_nothing_about_what_no_motion_errs_by():
    one, other = validate(STILL, moving(0.02, 0.1)), validate(network(), moving(0.02, 0.1))
    assert (one.constant_mm_4, one.constant_deg_4, one.windows) == (
        other.constant_mm_4,
        other.constant_deg_4,
        other.windows,
    )
    assert one.mm_4 != other.mm_4
