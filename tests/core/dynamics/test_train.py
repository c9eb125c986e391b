"""Train: network training, holdout, optimizers, samples, windows."""

import copy
import itertools
import json
from dataclasses import replace

import numpy as np
import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st
from safetensors.torch import load

from osfcore.dynamics import train as training
from osfcore.dynamics.graph import EDGE_FEATURES, MOTION, NODE_FEATURES, advance, build_graph, read_network, unroll
from osfcore.dynamics.motion import SUBSTEPS, Sweep, headings, sleeping, substates
from osfcore.dynamics.rollout import load_shapes
from osfcore.dynamics.shapes import ShapeTable
from osfcore.dynamics.train import (
    Optimizers,
    TrainDynamics,
    batch,
    distance,
    disturbed_substeps,
    has_held_out_pair,
    is_for_validation,
    is_held_out_pair,
    record,
    samples,
    train_dynamics,
    turn_between,
    validate,
)
from osfcore.errors import CannotWrite, CorruptFile, InvalidInput
from osfcore.fields.field_library import FieldLibrary
from osfcore.geometry.poses import quaternion_conjugate, quaternion_log, quaternion_multiply, rotate
from osfcore.io.push_file import Disturbed, EpisodeFolder, read_pushes, save_episode
from osfcore.world.collect_pushes import CollectPushes, collect_pushes
from tests.core.dynamics.scenes import APPLE, BOX, CAN, GELATIN, crowd, episode, network, picked, scene

# Network training


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


# Holdout


NAMES = FieldLibrary(None).names()
HELD_OUT_PAIRS = list(itertools.combinations(NAMES, 2))


def test_about_one_pair_in_sixteen_never_meets():
    held = [pair for pair in HELD_OUT_PAIRS if is_held_out_pair(*pair)]
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


# Optimizers


def graph(seed: int = 0) -> tuple[torch.Tensor, ...]:
    """Twenty objects, half of them pushed, some of them pairs."""
    torch.manual_seed(seed)
    nodes, edges = torch.randn(20, NODE_FEATURES), torch.randn(16, EDGE_FEATURES)
    receiver = torch.cat([torch.arange(10), torch.arange(6)])
    return nodes, edges, receiver, torch.arange(6) + 10


TARGET = graph()[0][:, :6]


def loss_of(model) -> torch.Tensor:
    return (model(*graph()) - TARGET).square().mean()


def down(descent: Optimizers, steps: int, first: int = 0) -> list[float]:
    losses = []
    for done in range(first, first + steps):
        loss = loss_of(descent.network)
        losses.append(float(loss.detach()))
        descent.step(loss, 1.0, done)
    return losses


def test_it_descends_and_its_average_follows():
    descent = Optimizers(network(), 1e-2)
    losses = down(descent, 60)
    assert losses[-1] < 0.1 * losses[0]
    with torch.no_grad():
        assert float(loss_of(descent.average)) < 0.2 * losses[0]


def test_every_parameter_moves():
    model = network()
    before = {name: value.clone() for name, value in model.state_dict().items()}
    descent = Optimizers(model, 1e-3)
    down(descent, 2)
    for name, value in descent.network.state_dict().items():
        assert not torch.equal(value, before[name]), name


def test_without_a_rate_nothing_moves():
    descent = Optimizers(network(), 1e-2)
    before = {name: value.clone() for name, value in descent.network.state_dict().items()}
    descent.step(loss_of(descent.network), 0.0, 0)
    assert all(torch.equal(value, before[name]) for name, value in descent.network.state_dict().items())


def test_matrices_are_updated_as_much_in_all_their_directions():
    """Muon's mark: the singular values of an update are nearly the same."""
    model = network(hidden=32)
    weight = model.node_encoder[2].weight
    before = weight.detach().clone()
    Optimizers(model, 1e-3).step(loss_of(model), 1.0, 0)
    values = torch.linalg.svdvals(weight.detach() - before)
    assert values[0] < 3 * values[len(values) // 2]


def test_the_average_begins_at_once_and_then_hardly_moves():
    descent = Optimizers(network(), 1e-2)
    down(descent, 1)
    for kept, new in zip(descent.average.parameters(), descent.network.parameters(), strict=True):
        assert torch.equal(kept, new)
    kept = [value.clone() for value in descent.average.parameters()]
    down(descent, 1, first=100_000)
    for old, now, new in zip(kept, descent.average.parameters(), descent.network.parameters(), strict=True):
        torch.testing.assert_close(now, old.lerp(new, 0.002))


@pytest.mark.parametrize("steps", [1, 3])
def test_a_restored_one_goes_on_in_the_same_way(steps):
    whole = Optimizers(network(), 1e-2)
    down(whole, steps)
    state = copy.deepcopy(whole.state())
    other = Optimizers(network(seed=5), 1e-2)
    other.restore(state)
    expected = down(whole, 2, first=steps)
    assert down(other, 2, first=steps) == expected


# Samples


@pytest.fixture(scope="module")
def begun(shapes):
    """A can pushed into a box, twice."""
    begins = [scene(shapes, {CAN: (0.06, y, (0, 0, 0.3)), GELATIN: (0.15, 0.0, (0, 0, 1.0))}) for y in (0.0, 0.01)]
    actions = np.tile([0.3, 0.05, 0.0], (5, 1))
    return [episode(shapes, begin, actions) for begin in begins]


@pytest.fixture(scope="module")
def sampled_recording(begun, shapes):
    return record(begun, shapes, 1)


@pytest.fixture(scope="module")
def drawn(sampled_recording, table):
    return samples(sampled_recording, table)


def test_every_substep_in_which_something_can_move_is_a_graph(drawn):
    assert 10 < len(drawn) <= 2 * 5 * SUBSTEPS
    everything = drawn.draw(torch.arange(len(drawn)), torch.zeros(len(drawn), dtype=torch.bool))
    assert len(everything.nodes) == len(drawn.nodes.values)
    assert len(everything.edges) == len(everything.receiver) >= len(everything.sender) > 0
    assert everything.target.shape == (len(everything.nodes), MOTION)
    assert everything.receiver.max() < len(everything.nodes)


def test_what_answers_the_targets_makes_what_was_recorded(sampled_recording, drawn, table):
    """One substep of a window with the target for an answer ends where the recording does."""
    graph = 0
    for number in range(len(sampled_recording.starts)):
        pieces = batch(sampled_recording, table, np.array([number]))
        motion = pieces.motion
        first = sampled_recording.starts[number][1] * SUBSTEPS
        path = sampled_recording.pusher[sampled_recording.starts[number][0]]
        sweep = Sweep(headings(pieces.velocity[0], motion), (path[first + 1] - path[first])[None])
        target = drawn.draw(torch.tensor([graph]), torch.zeros(1, dtype=torch.bool)).target

        def answer(nodes, *_, target=target):
            assert len(nodes) == len(target)
            return target

        after = advance(answer, table, pieces.number, motion, sweep)
        moved = (after.linear.abs().amax(dim=2) > 0)[0]
        error = (after.centre - pieces.targets.centre[0])[0][moved].norm(dim=1)
        assert (error < 2e-5).all()
        # the graphs of the window's four substeps, where it has them
        graph += sum(_has_graph(sampled_recording, table, number, k) for k in range(SUBSTEPS))
    assert graph == len(drawn)


def _has_graph(recording, table, number: int, substep: int) -> bool:
    e, first = recording.starts[number]
    at = first * SUBSTEPS + substep
    pieces = batch(replace(recording, starts=np.array([[e, first]]), is_busy=np.array([True])), table, np.array([0]))
    centre, quaternion = recording.centre[[e], at], recording.quaternion[[e], at]
    before = max(at - 1, 0)
    angular = turn_between(recording.quaternion[[e], before], quaternion)
    motion = sleeping(pieces.motion._replace(
        centre=centre, quaternion=quaternion, linear=centre - recording.centre[[e], before], angular=angular,
        pusher=recording.pusher[[e], at]))  # fmt: skip
    shift = recording.pusher[[e], at + 1] - motion.pusher
    heading = headings(recording.velocity[[e], first], motion)
    return len(build_graph(table, pieces.number, motion, Sweep(heading, shift)).scene) > 0


def beside(recorded) -> Disturbed:
    """Rows that repeat what was recorded itself."""
    poses = substates(recorded)
    step = np.arange(1, len(poses.position) - 1)
    turned = quaternion_multiply(poses.quaternion[step], quaternion_conjugate(poses.quaternion[step - 1]))
    angular = quaternion_log(turned)
    linear = np.diff(poses.position, axis=0)[step - 1]
    parts = (poses.position[step], poses.quaternion[step], linear, angular,
             poses.position[step + 1], poses.quaternion[step + 1])  # fmt: skip
    return Disturbed(step, *(part.astype(np.float32) for part in parts))


def test_disturbed_states_become_graphs_like_recorded_ones(begun, shapes, table):
    """Rows that repeat the recording teach what it teaches."""
    recorded = begun[0]
    plain = samples(record([recorded], shapes, 1), table)
    rows = list(disturbed_substeps([replace(recorded, disturbed=beside(recorded)), recorded], shapes))
    both = samples(record([recorded], shapes, 1), table, others=rows)
    assert len(rows) == 1
    assert len(plain) < len(both) <= 2 * len(plain)
    old = plain.draw(torch.arange(len(plain)), torch.zeros(len(plain), dtype=torch.bool))
    kept = both.draw(torch.arange(len(plain)), torch.zeros(len(plain), dtype=torch.bool))
    assert torch.equal(old.nodes, kept.nodes)
    extra = len(both) - len(plain)
    new = both.draw(torch.arange(len(plain), len(both)), torch.zeros(extra, dtype=torch.bool))
    last = plain.draw(torch.arange(len(plain) - extra, len(plain)), torch.zeros(extra, dtype=torch.bool))
    assert new.nodes.shape == last.nodes.shape
    off = (new.target - last.target).abs()
    assert off.median() < 0.01
    assert off.mean() < 0.05


def test_episodes_without_disturbed_states_add_nothing(begun, shapes):
    assert list(disturbed_substeps(begun, shapes)) == []


def test_graphs_drawn_together_answer_as_they_do_alone(drawn):
    net, numbers = network(), torch.tensor([3, 7, 3, len(drawn) - 1])
    flipped = torch.tensor([False, True, True, False])

    def answers(which, flags):
        sample = drawn.draw(which, flags)
        return net(sample.nodes, sample.edges, sample.receiver, sample.sender), sample.target

    with torch.no_grad():
        together, targets = answers(numbers, flipped)
        alone = [answers(numbers[k : k + 1], flipped[k : k + 1]) for k in range(len(numbers))]
    torch.testing.assert_close(together, torch.cat([a for a, _ in alone]), atol=1e-5, rtol=1e-5)
    torch.testing.assert_close(targets, torch.cat([t for _, t in alone]))


# Windows


PUSH = [[0.3, 0.0, 0], [0.2, 0.05, 0], [0.1, -0.1, 0], [-0.3, 0, 0], [-0.3, 0, 0], [0, 0, 0]]


@pytest.fixture(scope="module")
def pushed(shapes):
    return episode(shapes, crowd(shapes), PUSH)


def test_a_recording_tells_what_the_episode_tells(shapes, pushed):
    recording = record([pushed, pushed], shapes, 2)
    assert recording.centre.shape == (2, 6 * SUBSTEPS + 1, 4, 3)
    assert recording.pusher.shape == (2, 6 * SUBSTEPS + 1, 2)
    names = sorted(shapes)
    assert [names[n] for n in recording.number[0]] == list(pushed.names)
    centres = pushed.positions + rotate(pushed.quaternions, np.array([shapes[n].centre for n in pushed.names]))
    np.testing.assert_allclose(recording.centre[1, ::SUBSTEPS], centres, atol=1e-6)
    np.testing.assert_allclose(recording.quaternion[1, ::SUBSTEPS], pushed.quaternions, atol=1e-6)
    np.testing.assert_allclose(recording.pusher[1, ::SUBSTEPS], pushed.pusher[:, :2], atol=1e-6)
    np.testing.assert_allclose(recording.velocity[0], np.array(PUSH)[:, :2], atol=1e-6)
    assert recording.length == 2


@pytest.mark.parametrize("length", [1, 3, 6])
def test_windows_begin_wherever_they_fit(shapes, pushed, length):
    recording = record([pushed, pushed], shapes, length)
    expected = [(e, t) for e in range(2) for t in range(6 - length + 1)]
    assert [tuple(start) for start in recording.starts] == expected
    busy = [any(pushed.contact[t : t + length].any() for t in [start]) for _, start in expected]
    assert all(recording.is_busy[np.array(busy)])
    if length == 1:
        assert not recording.is_busy[-1]  # the pusher has left and everything rests


def test_what_comes_near_the_edge_is_not_learned_from(shapes, pushed):
    positions = pushed.positions.copy()
    positions[3, 0, 0] = 0.57
    starts = record([replace(pushed, positions=positions)], shapes, 2).starts[:, 1]
    np.testing.assert_array_equal(starts, [0, 4])
    positions = pushed.positions.copy()
    positions[6, 1, 2] = -0.7
    np.testing.assert_array_equal(record([replace(pushed, positions=positions)], shapes, 2).starts[:, 1], range(4))
    positions[:, 1, 2] = -0.7
    assert record([replace(pushed, positions=positions)], shapes, 2).starts.shape == (0, 2)


def test_a_window_rolled_out_with_what_made_it_meets_its_targets(shapes, table, pushed):
    """States and velocities at the start of a window are all there is to know."""
    recording = record([pushed], shapes, 2)
    pieces = batch(recording, table, np.arange(len(recording.starts)))
    assert pieces.targets.centre.shape == (2 * SUBSTEPS, 5, 4, 3)
    net = network(silent=True)
    with torch.inference_mode():
        motions = list(unroll(net, table, pieces.number, pieces.motion, pieces.velocity))
    for step, motion in enumerate(motions):
        error = (motion.centre - pieces.targets.centre[step]).norm(dim=-1)
        assert error.max() < 1e-3
        assert error.median() < 1e-5


def test_velocities_are_those_of_the_last_substep(shapes, table, pushed):
    recording = record([pushed], shapes, 1)
    pieces = batch(recording, table, np.arange(6))
    moved = recording.centre[0, SUBSTEPS] - recording.centre[0, SUBSTEPS - 1]
    torch.testing.assert_close(pieces.motion.linear[1, 0], moved[0])
    assert not pieces.motion.linear[0].any()  # the beginning of an episode is at rest
    assert not pieces.motion.linear[:, pushed.names.index(BOX)].any()
    assert pieces.motion.angular.shape == (6, 4, 3)
    assert pieces.motion.floor.max() <= 0
    np.testing.assert_allclose(pieces.velocity[0], np.array(PUSH)[:, :2], atol=1e-6)


def test_coarse_velocities_are_means_over_the_action_before(shapes, table, pushed):
    found = record([pushed], shapes, 1)
    windows = np.arange(len(found.starts))
    coarse = batch(found, table, windows, coarse=np.ones(len(windows), bool)).motion
    fine = batch(found, table, windows).motion
    for number, (_, start) in enumerate(found.starts):
        first = start * SUBSTEPS
        mean = (found.centre[0, first] - found.centre[0, max(first - SUBSTEPS, 0)]) / SUBSTEPS
        moves = coarse.linear[number].norm(dim=1) > 0
        torch.testing.assert_close(coarse.linear[number][moves], mean[moves], atol=1e-7, rtol=1e-5)
    assert torch.equal(coarse.linear[0], torch.zeros_like(coarse.linear[0]))
    assert not torch.equal(coarse.linear, fine.linear)
    assert torch.equal(coarse.centre, fine.centre)


def test_episodes_with_other_objects_go_together(shapes, table):
    one = episode(shapes, scene(shapes, {CAN: (0.06, 0.0), BOX: (-0.2, 0.0)}), PUSH)
    other = episode(shapes, scene(shapes, {GELATIN: (0.07, 0.0), CAN: (0.2, 0.1)}), PUSH)
    recording = record([one, other], shapes, 1)
    names = sorted(shapes)
    assert [[names[n] for n in row] for row in recording.number] == [[CAN, BOX], [GELATIN, CAN]]
    last = batch(recording, table, np.array([len(recording.starts) - 1]))
    assert [names[n] for n in last.number[0]] == [GELATIN, CAN]


@pytest.mark.parametrize("change", ["without", "fewer"])
def test_recordings_without_the_right_substeps_are_refused(shapes, pushed, change):
    if change == "without":
        wrong = replace(pushed, sub_positions=None, sub_quaternions=None)
    else:
        wrong = replace(
            pushed, sub_positions=pushed.sub_positions[:, 1:], sub_quaternions=pushed.sub_quaternions[:, 1:]
        )
    with pytest.raises(InvalidInput, match="collect pushes"):
        record([wrong], shapes, 1)


def test_episodes_that_do_not_fit_together_are_refused(shapes, pushed):
    short = episode(shapes, crowd(shapes), PUSH[:3])
    few = episode(shapes, picked(crowd(shapes), [0, 1]), PUSH)
    for episodes, length in (([pushed, short], 1), ([pushed, few], 1), ([short], 4), ([], 1)):
        with pytest.raises(InvalidInput, match="steps and objects of the episodes"):
            record(episodes, shapes, length)


def test_real_collections_can_be_learned_from(library, tmp_path):
    config = CollectPushes(tmp_path / "a.h5", episodes=2, steps=8, policy="directed")
    list(collect_pushes(config, library))
    episodes = read_pushes(config.out)
    shapes = load_shapes(None, FieldLibrary(None), {name for e in episodes for name in e.names})
    recording = record(episodes, shapes, 3)
    assert len(recording.starts) == 12
    assert recording.is_busy.any()
    for number, e in enumerate(episodes):
        told = recording.pusher[number, ::SUBSTEPS].numpy()
        np.testing.assert_allclose(told, e.pusher[:, :2], atol=1e-5)
    table = ShapeTable(tuple(shapes[name] for name in sorted(shapes)))
    pieces = batch(recording, table, np.arange(12))
    assert pieces.motion.floor.min() > -0.004  # fields and collision shapes agree on where the table is
    step = (pieces.targets.centre[0] - pieces.motion.centre).norm(dim=-1)
    assert step.max() < 0.05  # nothing jumps
