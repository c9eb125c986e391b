import json
from dataclasses import replace

import numpy as np
import pytest
import torch
from safetensors.torch import load

from osfcore.dynamics import train as training
from osfcore.dynamics.graph import read_network, unroll
from osfcore.dynamics.train import TrainDynamics, batch, distance, is_held_out_pair, record, train_dynamics, validate
from osfcore.errors import CannotWrite, CorruptFile, InvalidInput
from osfcore.io.push_file import EpisodeFolder, save_episode
from tests.core.dynamics.scenes import APPLE, BOX, CAN, GELATIN, episode, network, scene

PAIRS = [pair for pair in ((CAN, GELATIN), (CAN, APPLE), (GELATIN, APPLE)) if not is_held_out_pair(*pair)]


def pushes(shapes, first: str, second: str, seed: int, **options):
    rng = np.random.default_rng(seed)
    begin = scene(shapes, {first: (0.065, rng.uniform(-0.01, 0.01), (0, 0, rng.uniform(-3, 3))), second: (0.17, 0.0)})
    actions = np.column_stack([rng.uniform(0.1, 0.3, 5), rng.uniform(-0.1, 0.1, 5), np.zeros(5)])
    return episode(shapes, begin, actions, **options)


def write(path, episodes):
    with EpisodeFolder(path, {}) as folder:
        for number, e in enumerate(episodes):
            save_episode(folder.path(number), e)
        folder.combine(len(episodes))
    return path


@pytest.fixture(scope="module")
def data(shapes, tmp_path_factory):
    """Fourteen episodes, two of them to stop by."""
    episodes = [pushes(shapes, *PAIRS[seed % len(PAIRS)], seed) for seed in range(14)]
    return write(tmp_path_factory.mktemp("pushes") / "pushes.h5", episodes)


def config(data, folder, **changes) -> TrainDynamics:
    settings = {"iterations": 4, "long_iterations": 2, "batch": 6, "long_batch": 2, "hidden": 8, "patience": 10}
    return TrainDynamics((data,), folder / "net.safetensors", device="cpu", **{**settings, **changes})


@pytest.fixture
def often(monkeypatch):
    """Measure, save and tell so often that short runs have something to tell."""
    monkeypatch.setattr(training, "_MEASURE_EVERY", 2)
    monkeypatch.setattr(training, "_MEASURE_LONG_EVERY", 1)
    monkeypatch.setattr(training, "_REPORT_EVERY", 1)


def weights(path) -> dict[str, torch.Tensor]:
    return load(path.read_bytes())


def assert_same_weights(a, b) -> None:
    a, b = weights(a), weights(b)
    assert all(torch.equal(a[name], b[name]) for name in a)


@pytest.mark.usefixtures("often")
def test_a_run_writes_a_network_and_what_is_known_of_it(data, tmp_path, shapes):
    settings = config(data, tmp_path)
    steps = list(train_dynamics(settings, shapes))
    assert (steps[0].done, steps[-1].done, steps[-1].total) == (0, 6, 6)
    assert [s.done for s in steps] == sorted(s.done for s in steps)
    assert "held out" in steps[-1].note
    assert read_network(settings.out).hidden == 8
    told = json.loads(settings.out.with_suffix(".json").read_text(), parse_constant=pytest.fail)
    measured = {f"validation_{n}" for n in ("windows", "mm_4", "deg_4", "mean_mm_4", "loss", "constant_mm_4")}
    own = {"iterations", "seed", "device", "bytes", "episodes", "substeps", "without", "threads", "data", "command"}
    assert set(told) == measured | own
    assert (told["iterations"], told["episodes"], told["device"], told["data"]) == (6, 12, "cpu", ["pushes.h5"])
    assert told["bytes"] == settings.out.stat().st_size
    assert told["validation_windows"] > 0
    assert told["validation_constant_mm_4"] > 10
    assert {p.name for p in tmp_path.iterdir()} == {"net.safetensors", "net.json"}  # no checkpoint is left


def test_the_command_says_how_to_do_it_again(data, tmp_path):
    plain = TrainDynamics((data,), tmp_path / "net.safetensors")
    assert plain.command == "osf train dynamics --data pushes.h5 --out net.safetensors"
    told = replace(plain, iterations=5, long_batch=7, without=(CAN, "a b"), seed=3).command
    assert told.endswith(f"--iterations 5 --long-batch 7 --seed 3 --without {CAN} 'a b'")


@pytest.mark.usefixtures("often")
def test_an_abandoned_run_goes_on_and_ends_as_a_whole_one(data, tmp_path, shapes):
    whole = config(data, tmp_path / "whole")
    list(train_dynamics(whole, shapes))
    parts = config(data, tmp_path / "parts")
    begun = train_dynamics(parts, shapes)
    for step in begun:
        if step.done == 3:
            break
    begun.close()
    assert not parts.out.exists()
    going_on = [s.done for s in train_dynamics(parts, shapes)]
    assert going_on[:2] == [0, 3]  # from the checkpoint after the second iteration
    assert_same_weights(whole.out, parts.out)


@pytest.mark.slow
@pytest.mark.usefixtures("often")
@pytest.mark.parametrize("damage", ["other settings", "cut short", "rubbish"])
def test_a_checkpoint_that_does_not_fit_is_not_gone_on_with(data, tmp_path, shapes, damage):
    settings = config(data, tmp_path)
    begun = train_dynamics(replace(settings, seed=1) if damage == "other settings" else settings, shapes)
    while next(begun).done < 2:
        pass
    begun.close()
    checkpoint = settings.out.with_suffix(".checkpoint")
    content = checkpoint.read_bytes()
    if damage != "other settings":
        checkpoint.write_bytes(content[: len(content) // 2] if damage == "cut short" else b"rubbish")
    assert [s.done for s in train_dynamics(settings, shapes)][1] == 1


@pytest.mark.usefixtures("often")
@pytest.mark.parametrize("lost", ["best", "rng"])
def test_a_checkpoint_that_cannot_be_gone_on_from_ends_the_training_and_stays(data, tmp_path, shapes, lost):
    settings = config(data, tmp_path)
    begun = train_dynamics(settings, shapes)
    while next(begun).done < 3:
        pass
    begun.close()
    checkpoint = settings.out.with_suffix(".checkpoint")
    content = torch.load(checkpoint)
    torch.save({key: value for key, value in content.items() if key != lost}, checkpoint)
    kept = checkpoint.read_bytes()
    with pytest.raises(CorruptFile, match="delete it"):
        list(train_dynamics(settings, shapes))
    assert checkpoint.read_bytes() == kept
    assert not settings.out.exists()


def test_the_same_seed_gives_the_same_weights_and_another_seed_others(data, tmp_path, shapes):
    for folder, seed in (("a", 0), ("b", 0), ("c", 1)):
        list(train_dynamics(config(data, tmp_path / folder, iterations=2, long_iterations=1, seed=seed), shapes))
    assert_same_weights(tmp_path / "a" / "net.safetensors", tmp_path / "b" / "net.safetensors")
    a, c = weights(tmp_path / "a" / "net.safetensors"), weights(tmp_path / "c" / "net.safetensors")
    assert any(not torch.equal(a[name], c[name]) for name in a)


@pytest.mark.usefixtures("often")
def test_training_stops_when_nothing_gets_better(data, tmp_path, shapes):
    settings = config(data, tmp_path, iterations=100, long_iterations=100, patience=1, rate=1e-9)
    list(train_dynamics(settings, shapes))
    told = json.loads(settings.out.with_suffix(".json").read_text())
    assert told["iterations"] < 20


@pytest.mark.parametrize(
    ("change", "words"),
    [
        ({"iterations": 0}, "number of iterations is 0"),
        ({"batch": 0}, "batch is 0"),
        ({"long_batch": 0}, "batch of windows is 0"),
        ({"long_iterations": -1}, "iterations on windows is -1"),
        ({"hidden": 0}, "width of the network is 0"),
        ({"hidden": 1025}, "width of the network is 1025"),
        ({"patience": 0}, "patience is 0"),
        ({"rate": 0.0}, "rate of learning is 0"),
        ({"rate": float("nan")}, "rate of learning is nan"),
        ({"seed": -1}, "seed is -1"),
        ({"device": "tpu"}, "device"),
        ({"without": (CAN, GELATIN, APPLE)}, "episodes to learn from is 0"),
        ({"data": ()}, "episodes to learn from is 0"),
    ],
)
def test_bad_settings_are_refused_and_nothing_is_written(data, tmp_path, shapes, change, words):
    with pytest.raises(InvalidInput, match=words):
        list(train_dynamics(replace(config(data, tmp_path), **change), shapes))
    assert not list(tmp_path.iterdir())


def test_bad_places_and_files_are_told(data, tmp_path, shapes):
    good = config(data, tmp_path)
    with pytest.raises(InvalidInput, match=r"\.safetensors"):
        list(train_dynamics(replace(good, out=tmp_path / "net.pt"), shapes))
    (tmp_path / "file").write_text("not a push file")
    with pytest.raises(CannotWrite):
        list(train_dynamics(replace(good, out=tmp_path / "file" / "net.safetensors"), shapes))
    with pytest.raises(CorruptFile, match="file"):
        list(train_dynamics(replace(good, data=(tmp_path / "file",)), shapes))
    (tmp_path / "net.json").write_text("{}")
    with pytest.raises(InvalidInput, match=r"net\.json beside it"):
        list(train_dynamics(good, shapes))


def test_objects_left_out_are_in_no_episode(data, tmp_path, shapes):
    settings = config(data, tmp_path, iterations=1, without=(APPLE,))
    expected = sum(APPLE not in PAIRS[n % len(PAIRS)] for n in range(14) if n % 12)
    if not any(APPLE not in PAIRS[n % len(PAIRS)] for n in (0, 12)):
        pytest.skip("the pair that validates would be left out")
    list(train_dynamics(settings, shapes))
    told = json.loads(settings.out.with_suffix(".json").read_text())
    assert told["episodes"] == expected < 12
    assert told["without"] == [APPLE]


def test_objects_that_never_meet_are_not_learned_from(data, tmp_path, shapes, monkeypatch):
    held = PAIRS[1]
    monkeypatch.setattr(training, "has_held_out_pair", lambda names: set(names) == set(held))
    settings = config(data, tmp_path, iterations=1)
    list(train_dynamics(settings, shapes))
    told = json.loads(settings.out.with_suffix(".json").read_text())
    assert told["episodes"] == sum(PAIRS[n % len(PAIRS)] != held for n in range(14) if n % 12)


def test_objects_without_a_field_are_left_out_and_named_if_nothing_is_left(data, tmp_path, shapes):
    with pytest.raises(InvalidInput, match=rf"0 \(objects without a field: .*{CAN}.*\)"):
        list(train_dynamics(config(data, tmp_path), {BOX: shapes[BOX]}))


def test_recordings_without_substeps_are_told(tmp_path, shapes):
    path = write(tmp_path / "old.h5", [pushes(shapes, *PAIRS[0], seed, substates=False) for seed in range(3)])
    with pytest.raises(InvalidInput, match="without poses within its actions"):
        list(train_dynamics(config(path, tmp_path), shapes))


def test_recordings_in_which_nothing_is_touched_are_told(tmp_path, shapes):
    begin = scene(shapes, {PAIRS[0][0]: (0.2, 0.0), PAIRS[0][1]: (0.2, 0.2)})
    away = episode(shapes, begin, np.tile([-0.1, 0.0, 0.0], (5, 1)))
    path = write(tmp_path / "away.h5", [away] * 3)
    with pytest.raises(InvalidInput, match="steps in which an object could move is 0"):
        list(train_dynamics(config(path, tmp_path), shapes))


@pytest.fixture(scope="module")
def recording(shapes):
    return record([pushes(shapes, *PAIRS[0], seed) for seed in range(3)], shapes, 4)


def test_what_made_the_recording_has_no_error(recording, table):
    found = validate(network(silent=True), table, recording)
    assert found.windows > 0
    assert found.mm_4 < 0.5
    assert found.deg_4 < 0.5
    assert found.constant_mm_4 > 10


def test_where_nothing_ever_happens_all_windows_are_measured(recording, table):
    quiet = replace(recording, is_busy=np.zeros_like(recording.is_busy))
    busy = replace(recording, is_busy=np.ones_like(recording.is_busy))
    net = network()
    assert validate(net, table, quiet) == validate(net, table, busy)


@pytest.mark.slow
def test_recordings_in_which_everything_falls_off_the_table_are_told(tmp_path, shapes):
    fallen = []
    for seed in range(13):
        episode = pushes(shapes, *PAIRS[0], seed)
        positions = episode.positions.copy()
        positions[..., 2] = -0.7
        fallen.append(replace(episode, positions=positions))
    with pytest.raises(InvalidInput, match="stay on the table is 0"):
        list(train_dynamics(config(write(tmp_path / "fallen.h5", fallen), tmp_path), shapes))


def test_a_network_that_learned_nothing_is_worse(recording, table):
    exact, random = validate(network(silent=True), table, recording), validate(network(), table, recording)
    assert random.loss > exact.loss + 1
    assert random.mm_4 > exact.mm_4
    assert random.constant_mm_4 == exact.constant_mm_4


def test_distance_is_that_of_the_centre_and_of_the_turn(recording, table):
    pieces = batch(recording, table, np.arange(2))
    truth = pieces.motion._replace(centre=pieces.targets.centre[0], quaternion=pieces.targets.quaternion[0])
    assert distance(truth, pieces, 0).max() < 2e-4
    shifted = truth._replace(centre=truth.centre + torch.tensor([0.003, 0.0, 0.004]))
    torch.testing.assert_close(distance(shifted, pieces, 0), torch.full((2, 2), 0.005), atol=1e-5, rtol=0)
    flipped = truth._replace(quaternion=-truth.quaternion)  # the same orientation
    assert distance(flipped, pieces, 0).max() < 2e-4


def test_a_step_of_descent_lowers_the_loss_of_its_own_batch(recording, table):
    net = network()
    pieces = batch(recording, table, np.arange(6))

    def loss():
        motions = unroll(net, table, pieces.number, pieces.motion, pieces.velocity[:1])
        return sum(distance(m, pieces, step).sum() for step, m in enumerate(motions))

    optimiser = torch.optim.Adam(net.parameters(), lr=1e-3)
    first = loss()
    for _ in range(15):
        optimiser.zero_grad()
        loss().backward()
        optimiser.step()
    assert loss() < 0.9 * first
