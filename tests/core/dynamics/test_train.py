"""Train: network training, holdout, optimizers, samples, windows."""

import itertools
import json
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st
from safetensors.torch import load

from osfcore.dynamics import train as training
from osfcore.dynamics.graph import EDGE_FEATURES, NODE_FEATURES, advance, read_network, unroll
from osfcore.dynamics.motion import SUBSTEPS, Sweep, headings, substates
from osfcore.dynamics.rollout import load_shapes
from osfcore.dynamics.shapes import ShapeTable
from osfcore.dynamics.train import (
    Optimizers,
    PushTraining,
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
    validate,
)
from osfcore.errors import CannotWrite, CorruptFile, InvalidInput
from osfcore.fields.field_library import FieldLibrary
from osfcore.geometry.poses import quaternion_conjugate, quaternion_log, quaternion_multiply, rotate
from osfcore.io.push_file import Disturbed, read_pushes
from osfcore.world.collect_pushes import CollectPushes, collect_pushes
from tests.core.dynamics.scenes import APPLE, BOX, CAN, GELATIN, crowd, episode, network, picked, scene, write
from tests.support.errors import about

# Network training


NAMES = FieldLibrary(None).names()
HELD_OUT_PAIRS = list(itertools.combinations(NAMES, 2))
PAIRS = [pair for pair in ((CAN, GELATIN), (CAN, APPLE), (GELATIN, APPLE)) if not is_held_out_pair(*pair)]


def pushes(shapes, first: str, second: str, seed: int, **options):
    rng = np.random.default_rng(seed)
    begin = scene(shapes, {first: (0.065, rng.uniform(-0.01, 0.01), (0, 0, rng.uniform(-3, 3))), second: (0.17, 0.0)})
    actions = np.column_stack([rng.uniform(0.1, 0.3, 5), rng.uniform(-0.1, 0.1, 5), np.zeros(5)])
    return episode(shapes, begin, actions, **options)


@pytest.fixture(scope="module")
def data(shapes, tmp_path_factory):
    """Four episodes, the first of them to stop by."""
    episodes = [pushes(shapes, *PAIRS[seed % len(PAIRS)], seed) for seed in range(4)]
    return write(tmp_path_factory.mktemp("pushes") / "pushes.h5", episodes)


def config(data, folder, **changes) -> TrainDynamics:
    settings = {"iterations": 20, "long_iterations": 2, "batch": 6, "long_batch": 2, "hidden": 8, "patience": 10}
    return TrainDynamics((data,), folder / "net.safetensors", device="cpu", **{**settings, **changes})


def metrics(settings: TrainDynamics) -> dict:
    return json.loads(settings.out.with_suffix(".json").read_text(), parse_constant=pytest.fail)


@pytest.fixture(scope="module")
def whole(data, shapes, tmp_path_factory):
    """A run and its steps."""
    settings = config(data, tmp_path_factory.mktemp("whole"))
    return settings, list(train_dynamics(settings, shapes))


def test_a_run_writes_a_network_and_what_is_known_of_it(whole):
    settings, steps = whole
    assert [(s.done, s.total) for s in steps] == [(0, 22), (20, 22), (22, 22)]
    assert read_network(settings.out).hidden == 8
    found = metrics(settings)
    measured = {f"validation_{n}" for n in ("windows", "mm_4", "deg_4", "mean_mm_4", "loss", "constant_mm_4")}
    own = {"iterations", "seed", "device", "bytes", "episodes", "substeps", "without", "threads", "data", "command"}
    assert set(found) == measured | own
    assert (found["iterations"], found["episodes"], found["device"], found["data"]) == (22, 3, "cpu", ["pushes.h5"])
    assert found["bytes"] == settings.out.stat().st_size
    assert found["validation_windows"] > 0
    assert found["validation_constant_mm_4"] > 10
    assert {p.name for p in settings.out.parent.iterdir()} == {"net.safetensors", "net.json"}  # no checkpoint is left


def test_the_command_says_how_to_do_it_again(data, tmp_path):
    plain = TrainDynamics((data,), tmp_path / "net.safetensors")
    assert plain.command == "osf train dynamics --data pushes.h5 --out net.safetensors"
    words = replace(plain, iterations=5, long_batch=7, without=(CAN, "a b"), seed=3).command
    assert words.endswith(f"--iterations 5 --long-batch 7 --seed 3 --without {CAN} 'a b'")


def test_what_is_left_of_a_part_is_skipped_when_nothing_gets_better(data, tmp_path, shapes, monkeypatch):
    monkeypatch.setattr(training, "_MEASURE_LONG_EVERY", 1)
    settings = config(data, tmp_path, iterations=1, long_iterations=100, long_batch=1, patience=1, rate=1e-9)
    list(train_dynamics(settings, shapes))
    assert metrics(settings)["iterations"] < 20


def test_bad_settings_places_and_files_are_refused_before_anything_is_written(data, tmp_path, shapes):
    for subject, change in (
        ("number of iterations", {"iterations": 0}),
        ("batch", {"batch": 0}),
        ("batch of windows", {"long_batch": 0}),
        ("iterations on windows", {"long_iterations": -1}),
        ("width of the network", {"hidden": 1025}),
        ("patience", {"patience": 0}),
        ("rate of learning", {"rate": float("nan")}),
        ("seed", {"seed": -1}),
        ("device", {"device": "tpu"}),
        ("episodes to learn from", {"without": (CAN, GELATIN, APPLE)}),
        ("episodes to learn from", {"data": ()}),
    ):
        with pytest.raises(InvalidInput, check=about(subject)):
            list(train_dynamics(replace(config(data, tmp_path), **change), shapes))
    assert not list(tmp_path.iterdir())
    good = config(data, tmp_path)
    with pytest.raises(InvalidInput):
        list(train_dynamics(replace(good, out=tmp_path / "net.pt"), shapes))
    (tmp_path / "file").write_text("not a push file")
    with pytest.raises(CannotWrite):
        list(train_dynamics(replace(good, out=tmp_path / "file" / "net.safetensors"), shapes))
    with pytest.raises(CorruptFile, check=about("file")):
        list(train_dynamics(replace(good, data=(tmp_path / "file",)), shapes))
    with pytest.raises(InvalidInput, match=CAN):  # an object without a field
        list(train_dynamics(good, {BOX: shapes[BOX]}))
    (tmp_path / "net.json").write_text("{}")
    with pytest.raises(InvalidInput):
        list(train_dynamics(good, shapes))


def test_objects_left_out_and_pairs_held_out_are_not_learned_from(shapes, tmp_path):
    held = next(pair for pair in HELD_OUT_PAIRS if is_held_out_pair(*pair))
    free = next(pair for pair in HELD_OUT_PAIRS if not is_held_out_pair(*pair) and not set(pair) & set(held))
    left_out = (held[0], "other")  # never held out
    named = dict.fromkeys((*held, *free, "other"), shapes[CAN])
    recorded = pushes(shapes, CAN, GELATIN, 0)
    episodes = [replace(recorded, names=names) for names in (free, held, free, left_out, free)]
    settings = config(write(tmp_path / "a.h5", episodes), tmp_path, iterations=1, long_iterations=0)
    for without, count in (((), 3), ((held[0],), 2)):
        list(train_dynamics(replace(settings, without=without), named))
        found = metrics(settings)
        assert (found["episodes"], found["without"]) == (count, list(without))


def test_recordings_in_which_nothing_is_touched_are_refused(tmp_path, shapes):
    begin = scene(shapes, {PAIRS[0][0]: (0.2, 0.0), PAIRS[0][1]: (0.2, 0.2)})
    away = episode(shapes, begin, np.tile([-0.1, 0.0, 0.0], (5, 1)))
    path = write(tmp_path / "away.h5", [away] * 3)
    with pytest.raises(InvalidInput, check=about("an object could move")):
        list(train_dynamics(config(path, tmp_path), shapes))


def killed(settings: TrainDynamics, shapes) -> Path:
    """The checkpoint that a run leaves behind where windows begin."""
    steps = train_dynamics(settings, shapes)
    while next(steps).done < 20:
        pass
    steps.close()
    assert not settings.out.exists()
    return settings.out.with_suffix(".checkpoint")


@pytest.mark.parametrize("damage", ["none", "other settings", "cut short", "rubbish"])
def test_a_killed_run_goes_on_unless_its_checkpoint_does_not_fit_and_ends_with_the_same_weights(
    data, tmp_path, shapes, whole, damage
):
    settings = config(data, tmp_path)
    checkpoint = killed(replace(settings, seed=1) if damage == "other settings" else settings, shapes)
    content = checkpoint.read_bytes()
    if damage in ("cut short", "rubbish"):
        checkpoint.write_bytes(content[: len(content) // 2] if damage == "cut short" else b"rubbish")
    done = [step.done for step in train_dynamics(settings, shapes)]
    assert done == ([0, 22] if damage == "none" else [0, 20, 22])
    a, b = (load(one.out.read_bytes()) for one in (whole[0], settings))
    assert all(torch.equal(a[name], b[name]) for name in a)
    assert metrics(settings) == metrics(whole[0])
    assert not checkpoint.exists()


@dataclass(frozen=True)
class Size:
    mm_4: float
    deg_4: float = 0.0


class Growing(PushTraining):
    """A number that grows by one in each step, measured after every eighth one; the smaller the better."""

    measurement, score = Size, "mm_4"

    def __init__(self, out):
        self.number = torch.nn.Linear(1, 1, bias=False)
        torch.nn.init.zeros_(self.number.weight)
        super().__init__(self.number, {"number": self.number}, "growing", out=out, total=50, patience=2, seed=0)

    def iterate(self):
        with torch.no_grad():
            self.number.weight += 1
        self.done += 1
        return self.note

    def is_due(self):
        return self.done % 8 == 0

    def measured(self):
        return Size(self.number.weight.item()), self.number

    def described(self):
        return repr(self.number.weight.item()).encode(), {"iterations": self.done}


def test_a_run_ends_when_nothing_gets_better_and_the_best_weights_are_written(tmp_path):
    *_, last = Growing(tmp_path / "a.bin").run()
    assert float((tmp_path / "a.bin").read_text()) == 8
    assert json.loads((tmp_path / "a.json").read_text())["iterations"] == 24
    assert (last.done, last.total) == (50, 50)


@pytest.mark.parametrize("lost", ["descent", "best", "rng"])
def test_a_checkpoint_that_cannot_be_gone_on_from_ends_the_training_and_stays(data, tmp_path, shapes, lost):
    settings = config(data, tmp_path)
    checkpoint = killed(settings, shapes)
    content = torch.load(checkpoint)
    torch.save({key: value for key, value in content.items() if key != lost}, checkpoint)
    kept = checkpoint.read_bytes()
    with pytest.raises(CorruptFile, check=about("net.checkpoint")):
        list(train_dynamics(settings, shapes))
    assert checkpoint.read_bytes() == kept
    assert not settings.out.exists()


@pytest.fixture(scope="module")
def recording(shapes):
    return record([pushes(shapes, *PAIRS[0], seed) for seed in range(3)], shapes, 4)


def test_what_made_the_recording_has_no_error_and_what_learned_nothing_has(recording, table):
    exact, random = validate(network(silent=True), table, recording), validate(network(), table, recording)
    assert exact.windows > 0
    assert exact.mm_4 < 0.5
    assert exact.deg_4 < 0.5
    assert exact.constant_mm_4 == random.constant_mm_4 > 10
    assert random.loss > exact.loss + 1
    assert random.mm_4 > exact.mm_4


def test_distance_is_that_of_the_centre_and_of_the_turn(recording, table):
    pieces = batch(recording, table, np.arange(2))
    truth = pieces.motion._replace(centre=pieces.centre[0], quaternion=pieces.quaternion[0])
    assert distance(truth, pieces, 0).max() < 2e-4
    shifted = truth._replace(centre=truth.centre + torch.tensor([0.003, 0.0, 0.004]))
    torch.testing.assert_close(distance(shifted, pieces, 0), torch.full((2, 2), 0.005), atol=1e-5, rtol=0)
    flipped = truth._replace(quaternion=-truth.quaternion)  # the same orientation
    assert distance(flipped, pieces, 0).max() < 2e-4


# Holdout


def test_one_pair_in_sixteen_and_one_episode_in_twelve_are_held_out():
    held = [pair for pair in HELD_OUT_PAIRS if is_held_out_pair(*pair)]
    assert 5 <= len(held) <= 20  # of 190
    assert len({name for pair in held for name in pair}) >= 6
    assert sum(map(is_for_validation, range(1200))) == 100


@given(names=st.lists(st.sampled_from(NAMES), unique=True, max_size=6))
def test_a_scene_is_held_out_for_any_of_its_pairs(names):
    assert has_held_out_pair(names) == any(is_held_out_pair(a, b) for a in names for b in names if a != b)


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


def test_it_descends_with_every_parameter_and_its_average_follows():
    descent = Optimizers(network(), 1e-2)
    before = {name: value.clone() for name, value in descent.network.state_dict().items()}
    descent.step(loss_of(descent.network), 0.0, 0)  # without a rate nothing moves
    assert all(torch.equal(value, before[name]) for name, value in descent.network.state_dict().items())
    losses = down(descent, 60)
    assert losses[-1] < 0.1 * losses[0]
    with torch.no_grad():
        assert float(loss_of(descent.average)) < 0.2 * losses[0]
    for name, value in descent.network.state_dict().items():
        assert not torch.equal(value, before[name]), name


def test_the_average_begins_at_once_and_then_hardly_moves():
    descent = Optimizers(network(), 1e-2)
    down(descent, 1)
    for kept, new in zip(descent.average.parameters(), descent.network.parameters(), strict=True):
        assert torch.equal(kept, new)
    kept = [value.clone() for value in descent.average.parameters()]
    down(descent, 1, first=100_000)
    for old, now, new in zip(kept, descent.average.parameters(), descent.network.parameters(), strict=True):
        torch.testing.assert_close(now, old.lerp(new, 0.002))


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


def test_what_answers_the_targets_makes_what_was_recorded(shapes, table):
    """Substep by substep through an action, with the targets in place of a network's answers."""
    begin = scene(shapes, {CAN: (0.05, 0.0, (0, 0, 0.3)), GELATIN: (0.14, 0.0, (0, 0, 1.0))})
    recording = record([episode(shapes, begin, [[0.3, 0.05, 0.0]])], shapes, 1)
    pieces, drawn = batch(recording, table, np.array([0])), samples(recording, table)
    assert len(drawn) == SUBSTEPS
    motion = pieces.motion
    for step in range(SUBSTEPS):
        target = drawn.draw(torch.tensor([step]), torch.tensor([False])).target
        shift = recording.pusher[:, step + 1] - recording.pusher[:, step]
        sweep = Sweep(headings(pieces.velocity[0], motion), shift)
        motion = advance(lambda *_, target=target: target, table, pieces.number, motion, sweep)
        assert motion.linear.any()
        assert (motion.centre - pieces.centre[step]).norm(dim=2).max() < 3e-5


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
    assert list(disturbed_substeps(begun, shapes)) == []
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


def test_a_recording_holds_what_the_episode_holds(shapes, pushed):
    recording = record([pushed, pushed], shapes, 2)
    names = sorted(shapes)
    assert [names[n] for n in recording.number[0]] == list(pushed.names)
    centres = pushed.positions + rotate(pushed.quaternions, np.array([shapes[n].centre for n in pushed.names]))
    np.testing.assert_allclose(recording.centre[1, ::SUBSTEPS], centres, atol=1e-6)
    np.testing.assert_allclose(recording.quaternion[1, ::SUBSTEPS], pushed.quaternions, atol=1e-6)
    np.testing.assert_allclose(recording.pusher[1, ::SUBSTEPS], pushed.pusher[:, :2], atol=1e-6)
    np.testing.assert_allclose(recording.velocity[0], np.array(PUSH)[:, :2], atol=1e-6)


@pytest.mark.parametrize("length", [1, 6])
def test_windows_begin_wherever_they_fit(shapes, pushed, length):
    recording = record([pushed, pushed], shapes, length)
    expected = [(e, t) for e in range(2) for t in range(6 - length + 1)]
    assert [tuple(start) for start in recording.starts] == expected
    assert all(recording.is_busy[[bool(pushed.contact[t : t + length].any()) for _, t in expected]])
    assert recording.is_busy[-1] == (length == 6)  # in the last action the pusher has left and everything rests


def test_what_comes_near_the_edge_is_not_learned_from(shapes, pushed):
    positions = pushed.positions.copy()
    positions[3, 0, 0] = 0.57
    starts = record([replace(pushed, positions=positions)], shapes, 2).starts[:, 1]
    np.testing.assert_array_equal(starts, [0, 4])
    positions[:, 1, 2] = -0.7
    with pytest.raises(InvalidInput, check=about("stay on the table")):
        record([replace(pushed, positions=positions)], shapes, 2)


def test_a_window_rolled_out_with_what_made_it_meets_its_targets(shapes, table, pushed):
    """States and velocities at the start of a window are all there is to know."""
    recording = record([pushed], shapes, 2)
    pieces = batch(recording, table, np.arange(len(recording.starts)))
    assert pieces.centre.shape == (2 * SUBSTEPS, 5, 4, 3)
    net = network(silent=True)
    with torch.inference_mode():
        motions = list(unroll(net, table, pieces.number, pieces.motion, pieces.velocity))
    for step, motion in enumerate(motions):
        error = (motion.centre - pieces.centre[step]).norm(dim=-1)
        assert error.max() < 1e-3
        assert error.median() < 1e-5


def test_coarse_velocities_are_means_over_the_action_before(shapes, table, pushed):
    found = record([pushed], shapes, 1)
    windows = np.arange(len(found.starts))
    coarse = batch(found, table, windows, coarse=np.ones(len(windows), bool)).motion
    assert torch.equal(coarse.centre, batch(found, table, windows).motion.centre)
    ends = found.centre[0, ::SUBSTEPS][windows]
    for before, after, linear in zip(ends[:-1], ends[1:], coarse.linear[1:], strict=True):
        moves = linear.norm(dim=1) > 0
        torch.testing.assert_close(linear[moves], ((after - before) / SUBSTEPS)[moves], atol=1e-7, rtol=1e-5)
    assert not coarse.linear[0].any()
    assert coarse.linear[1:].any()


def test_recordings_that_do_not_fit_are_refused(shapes, pushed):
    positions, quaternions = pushed.sub_positions[:, 1:], pushed.sub_quaternions[:, 1:]
    for wrong in ((None, None), (positions, quaternions)):
        with pytest.raises(InvalidInput, check=about("push file")):
            record([replace(pushed, sub_positions=wrong[0], sub_quaternions=wrong[1])], shapes, 1)
    short = episode(shapes, crowd(shapes), PUSH[:3])
    few = episode(shapes, picked(crowd(shapes), [0, 1]), PUSH)
    for episodes, length in (([pushed, short], 1), ([pushed, few], 1), ([short], 4), ([], 1)):
        with pytest.raises(InvalidInput, check=about("steps and objects")):
            record(episodes, shapes, length)


@pytest.mark.slow
def test_real_collections_can_be_learned_from(library, tmp_path):
    config = CollectPushes(tmp_path / "a.h5", episodes=2, steps=8, policy="directed")
    list(collect_pushes(config, library))
    episodes = read_pushes(config.out)
    shapes = load_shapes(None, FieldLibrary(None), {name for e in episodes for name in e.names})
    recording = record(episodes, shapes, 3)
    assert recording.is_busy.any()
    for number, e in enumerate(episodes):
        np.testing.assert_allclose(recording.pusher[number, ::SUBSTEPS], e.pusher[:, :2], atol=1e-5)
    table = ShapeTable(tuple(shapes[name] for name in sorted(shapes)))
    pieces = batch(recording, table, np.arange(len(recording.starts)))
    assert pieces.motion.floor.min() > -0.004  # fields and collision shapes agree on where the table is
    assert (pieces.centre[0] - pieces.motion.centre).norm(dim=-1).max() < 0.05  # nothing jumps
