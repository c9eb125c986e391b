"""Train dynamics: training, recordings, validation."""

import json
from dataclasses import replace

import numpy as np
import pytest
import torch
from safetensors.torch import load

from osfcore.errors import CorruptFile, InvalidInput
from osfcore.geometry.poses import quaternion_exp
from osfcore.paper.dynamics import GraphNetwork, read_network
from osfcore.paper.train_dynamics import TrainPaperDynamics, record, train_paper_dynamics, validate, windows
from tests.core.dynamics.scenes import write
from tests.core.paper.scenes import BOX, CAN, KAPPAS, NAMES, episode, network
from tests.support.errors import about

# Training


@pytest.fixture(scope="module")
def data(tmp_path_factory):
    """Fourteen episodes, two of them to stop by."""
    return write(tmp_path_factory.mktemp("pushes") / "pushes.h5", [episode(seed) for seed in range(14)])


def config(data, folder, **changes) -> TrainPaperDynamics:
    settings = {"iterations": 6, "batch": 6, "hidden": 8, **changes}
    return TrainPaperDynamics((data,), folder / "net.safetensors", device="cpu", **settings)


def metrics(settings: TrainPaperDynamics) -> dict:
    return json.loads(settings.out.with_suffix(".json").read_text(), parse_constant=pytest.fail)


def assert_same_weights(a, b) -> None:
    a, b = load(a.read_bytes()), load(b.read_bytes())
    assert all(torch.equal(a[name], b[name]) for name in a)


def test_a_run_beats_predicting_no_motion_and_writes_what_is_known_of_it(data, tmp_path):
    settings = config(data, tmp_path, iterations=100, batch=32, hidden=16, rate=1e-2)
    steps = list(train_paper_dynamics(settings, KAPPAS))
    assert [(s.done, s.total) for s in steps] == [(done, 100) for done in (0, 20, 40, 60, 80, 100, 100)]
    assert (read_network(settings.out).hidden, read_network(settings.out).names) == (16, NAMES)
    found = metrics(settings)
    measured = ("windows", "mm_4", "deg_4", "mean_mm_4", "constant_mm_4", "constant_deg_4")
    own = {"iterations", "seed", "device", "machine", "threads", "bytes", "episodes", "windows", "data", "command"}
    assert set(found) == {f"validation_{name}" for name in measured} | own
    assert (found["iterations"], found["episodes"], found["windows"]) == (100, 12, 12 * 6)
    assert found["bytes"] == settings.out.stat().st_size
    assert found["validation_constant_mm_4"] > 10
    assert max(found["validation_mean_mm_4"], found["validation_mm_4"]) < 0.5 * found["validation_constant_mm_4"]
    assert {p.name for p in tmp_path.iterdir()} == {"net.safetensors", "net.json"}  # no checkpoint is left


def test_the_command_says_how_to_do_it_again(data, tmp_path):
    plain = TrainPaperDynamics((data,), tmp_path / "net.safetensors")
    assert plain.command == "osf train dynamics --method paper --data pushes.h5 --out net.safetensors"
    assert replace(plain, hidden=5, seed=3).command.endswith("--hidden 5 --seed 3")


@pytest.mark.slow
def test_a_killed_run_goes_on_to_the_same_weights_and_another_seed_has_others(data, tmp_path):
    whole, parts, other = (config(data, tmp_path / name, iterations=520, batch=1) for name in ("a", "b", "c"))
    list(train_paper_dynamics(whole, KAPPAS))
    begun = train_paper_dynamics(parts, KAPPAS)
    while next(begun).done < 500:  # it is measured and saved
        pass
    begun.close()
    assert [s.done for s in train_paper_dynamics(parts, KAPPAS)] == [0, 520, 520]
    assert_same_weights(whole.out, parts.out)
    list(train_paper_dynamics(replace(other, iterations=1, seed=1), KAPPAS))
    with pytest.raises(AssertionError):
        assert_same_weights(whole.out, other.out)


def test_settings_data_and_places_that_do_not_serve_are_refused(data, tmp_path):
    good = config(data, tmp_path)
    with pytest.raises(InvalidInput, check=about("patience")):
        list(train_paper_dynamics(replace(good, patience=0), KAPPAS))
    with pytest.raises(CorruptFile):
        list(train_paper_dynamics(replace(good, data=(tmp_path / "nowhere.h5",)), KAPPAS))
    with pytest.raises(InvalidInput, match=BOX):  # an object without a field
        list(train_paper_dynamics(good, {CAN: 0.1}))
    single = write(tmp_path / "single.h5", [episode(0), *(episode(n, names=("teapot", CAN)) for n in range(1, 3))])
    with pytest.raises(InvalidInput, check=about("episodes to learn from")):
        list(train_paper_dynamics(config(single, tmp_path), KAPPAS))


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


def test_predicting_no_motion_errs_by_the_motion_of_what_moves_or_of_everything():
    found = validate(STILL, moving(0.02, 0.1))
    assert found.windows == 5
    for mm in (found.mm_4, found.mean_mm_4, found.constant_mm_4):
        assert mm == pytest.approx(80, abs=1e-3)
    for deg in (found.deg_4, found.constant_deg_4):
        assert deg == pytest.approx(np.rad2deg(0.4), abs=0.1)
    # Where nothing moves, everything counts.
    found = validate(STILL, moving(0.0, 0.0))
    assert (found.windows, found.mm_4, found.constant_mm_4) == (0, pytest.approx(0, abs=1e-3), pytest.approx(0))
    random = validate(network(), moving(0.0, 0.0))
    assert random.mm_4 > 1
    assert random.constant_mm_4 == found.constant_mm_4
