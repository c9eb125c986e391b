import json
import signal
import subprocess
import sys
import time

import pytest

from app.cli.main import main
from app.cli.train import TrainFieldCommand
from osfcore.dynamics.graph import read_network
from osfcore.errors import CorruptFile, InvalidInput
from osfcore.fields.kiloosf import read_field
from osfcore.paper.dynamics import read_network as read_paper_network
from osfcore.world.collect_pushes import CollectPushes, collect_pushes
from tests.core.dynamics.scenes import write
from tests.core.paper.scenes import episode
from tests.support.ellipsoid_sets import write_set
from tests.support.errors import about
from tests.support.push_videos import write_videos


@pytest.fixture(scope="module")
def image_set(tmp_path_factory):
    return write_set(tmp_path_factory.mktemp("set") / "egg", train=24, size=48)


@pytest.mark.slow
def test_a_field_is_written_with_what_it_reaches(image_set, tmp_path, capsys):
    out = tmp_path / "egg.safetensors"
    result = TrainFieldCommand((image_set,), out, minutes=0.05, device="cpu").run()
    assert read_field(out).hidden > 0
    assert result == {"out": str(out), **json.loads(out.with_suffix(".json").read_text())}
    assert 15 < result["psnr_mask"] <= result["psnr_full"] < 60
    told = capsys.readouterr()
    assert f"{result['psnr_mask']:.1f} dB in the mask" in told.out
    assert "left" in told.err  # progress


@pytest.mark.slow
def test_a_killed_training_goes_on_when_the_same_command_is_run_again(image_set, tmp_path):
    out, log = tmp_path / "egg.safetensors", tmp_path / "log"
    command = [sys.executable, "-m", "app.cli", "train", "field", "--data", str(image_set), "--out", str(out)]
    command += ["--minutes", "0.25", "--device", "cpu", "--json"]
    with log.open("w") as file:
        process = subprocess.Popen(command, stdout=file, stderr=file)
    deadline = time.monotonic() + 120
    while not out.with_suffix(".partial").exists() and process.poll() is None and time.monotonic() < deadline:
        time.sleep(0.1)
    process.send_signal(signal.SIGKILL)
    process.wait()
    assert out.with_suffix(".partial").exists(), log.read_text()
    assert not out.exists()

    done = subprocess.run(command, capture_output=True, text=True, check=False, timeout=120)
    assert done.returncode == 0, done.stderr
    assert "Going on from a checkpoint" in done.stderr
    result = json.loads(done.stdout.splitlines()[-1])
    assert result["minutes"] == pytest.approx(0.25, abs=0.1)  # of both runs together
    assert result["psnr_mask"] > 15
    assert not out.with_suffix(".partial").exists()


def test_mistakes_are_told_before_anything_is_trained(image_set, tmp_path):
    with pytest.raises(InvalidInput, check=about("output file")):
        TrainFieldCommand((image_set,), tmp_path / "egg.npz").run()
    with pytest.raises(InvalidInput, check=about("minutes")):
        TrainFieldCommand((image_set,), tmp_path / "egg.safetensors", minutes=0).run()
    with pytest.raises(CorruptFile, check=about("anno.json")):
        TrainFieldCommand((tmp_path,), tmp_path / "egg.safetensors").run()
    with pytest.raises(InvalidInput):
        TrainFieldCommand((image_set, tmp_path), tmp_path / "egg.safetensors").run()
    with pytest.raises(InvalidInput):
        TrainFieldCommand((image_set, tmp_path / "egg"), tmp_path / "fields").run()
    with pytest.raises(InvalidInput, check=about("image sets")):
        TrainFieldCommand((), tmp_path / "egg.safetensors").run()
    with pytest.raises(InvalidInput, check=about("number of workers")):
        TrainFieldCommand((image_set,), tmp_path / "egg.safetensors", workers=0).run()
    assert not (tmp_path / "egg.safetensors").exists()


@pytest.fixture
def toy_pushes(tmp_path):
    return write(tmp_path / "pushes.h5", [episode(seed) for seed in range(14)])


def test_the_papers_model_is_trained_on_request(toy_pushes, tmp_path, capsys):
    out = tmp_path / "paper.safetensors"
    arguments = ["train", "dynamics", "--method", "paper", "--data", str(toy_pushes), "--out", str(out)]
    quick = ["--data-dir", str(tmp_path), "--iterations", "30", "--hidden", "8", "--batch", "4", "--device", "cpu"]
    assert main([*arguments, *quick, "--json"]) == 0
    result = json.loads(capsys.readouterr().out.splitlines()[-1])
    assert result == {"out": str(out), **json.loads(out.with_suffix(".json").read_text())}
    assert (result["iterations"], read_paper_network(out).hidden) == (30, 8)
    assert "--method paper" in result["command"]
    assert main([*arguments, *quick, "--rate", "0"]) == 2
    assert "rate of learning" in capsys.readouterr().err


@pytest.mark.parametrize("option", [("--long-iterations", "3"), ("--long-batch", "3"), ("--without", "teapot")])
def test_what_the_papers_model_has_not_cannot_be_asked_for(toy_pushes, tmp_path, capsys, option):
    out = tmp_path / "paper.safetensors"
    arguments = ["train", "dynamics", "--method", "paper", "--data", str(toy_pushes), "--out", str(out)]
    assert main([*arguments, *option]) == 2
    (line,) = capsys.readouterr().err.splitlines()
    assert option[0] in line
    assert not out.exists()


@pytest.mark.slow
def test_pushes_are_learned_from_collected_ones(library, tmp_path, capsys):
    pushes = tmp_path / "pushes.h5"
    config = CollectPushes(pushes, episodes=14, steps=8, policy="directed", seed=1)
    assert list(collect_pushes(config, library))[-1].done == 14
    out = tmp_path / "pushes.safetensors"
    arguments = ["train", "dynamics", "--data", str(pushes), "--out", str(out), "--data-dir", str(tmp_path)]
    quick = ["--iterations", "30", "--long-iterations", "2", "--hidden", "8", "--device", "cpu"]
    assert main([*arguments, *quick, "--json"]) == 0
    told = capsys.readouterr()
    result = json.loads(told.out.splitlines()[-1])
    assert result == {"out": str(out), **json.loads(out.with_suffix(".json").read_text())}
    assert result["iterations"] == 32
    assert "held out" in told.err
    assert read_network(out).hidden == 8
    assert main([*arguments, *quick, "--without", "teapot", "--rate", "0"]) == 2
    assert "rate of learning" in capsys.readouterr().err


def test_a_rival_is_trained_from_frames(tmp_path, capsys):
    frames, out = write_videos(tmp_path / "frames.h5"), tmp_path / "fitvid.safetensors"
    arguments = ["train", "fitvid", "--data", str(frames), "--out", str(out), "--iterations", "2", "--width", "1"]
    arguments += ["--batch", "2", "--frames", "3", "--no-augment", "--device", "cpu"]
    assert main([*arguments, "--json"]) == 0
    told = capsys.readouterr()
    result = json.loads(told.out.splitlines()[-1])
    assert result == {"out": str(out), **json.loads(out.with_suffix(".json").read_text())}
    assert (result["iterations"], result["videos"]) == (2, 2)
    assert "held out" in told.err
    assert main(arguments) == 0
    assert "the last known frame, copied" in capsys.readouterr().out
    assert main([*arguments, "--rate", "0"]) == 2
    assert "rate of learning" in capsys.readouterr().err


@pytest.mark.slow
def test_a_killed_rival_goes_on_when_the_same_command_is_run_again(tmp_path):
    frames, out = write_videos(tmp_path / "frames.h5"), tmp_path / "fitvid.safetensors"
    command = [sys.executable, "-m", "app.cli", "train", "fitvid", "--data", str(frames), "--out", str(out)]
    command += ["--iterations", "300", "--width", "1", "--batch", "2", "--frames", "3", "--save-every", "20"]
    process = subprocess.Popen([*command, "--device", "cpu"], stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL)
    deadline = time.monotonic() + 120
    while not out.with_suffix(".checkpoint").exists() and process.poll() is None and time.monotonic() < deadline:
        time.sleep(0.02)
    process.send_signal(signal.SIGKILL)
    process.wait()
    assert not out.exists()
    done = subprocess.run([*command, "--device", "cpu", "--json"], capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr
    assert not done.stderr.startswith("[  0 %]")
    assert json.loads(done.stdout.splitlines()[-1])["iterations"] == 300
