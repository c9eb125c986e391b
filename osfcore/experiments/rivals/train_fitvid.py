"""Training FitVid on recorded frames and actions.

As in the published program: windows of two context frames and ten more, beta 1e-4, Adam, gradients clipped at a norm of
100. Deviations: batches are of 8 instead of 128 windows, of whose frames four are decoded in each step; the rate is
2e-3, twice the published one, rises over the first steps and falls over the last fifth of the budget, for there are
minutes where the original has ten million steps. As for our dynamics, episodes with a held-out pair of objects are left
out.
"""

from __future__ import annotations

import math
import shlex
import time
from collections.abc import Iterator, Sequence
from contextlib import closing
from dataclasses import asdict, dataclass, fields, replace
from pathlib import Path
from typing import Any, Literal, NamedTuple

import numpy as np
import torch
from jaxtyping import Float, Float32, Int, UInt8
from torch import Tensor
from torch.nn import functional

from osfcore.dynamics.train import has_held_out_pair, is_for_validation
from osfcore.errors import CorruptFile, InvalidInput, check_ranges, check_seed
from osfcore.experiments.rivals.fitvid import CONTEXT, FitVidModel, FitVidSettings, write_fitvid
from osfcore.fields.devices import pick_device
from osfcore.geometry.cameras import goal_camera
from osfcore.geometry.workspace import PUSHER_CENTRE_Z_M, PUSHER_RADIUS_M
from osfcore.io.checkpoint import resume_from, write_checkpoint
from osfcore.io.files import write_json
from osfcore.io.output_paths import check_weights_place
from osfcore.io.push_file import PushEpisode, read_sound_pushes
from osfcore.metrics.image_errors import MOST_DB
from osfcore.objects.asset_library import AssetLibrary
from osfcore.progress import Progress
from osfcore.random_streams import Stream, stream_rng, stream_seed
from osfcore.world.scenes import SceneRequest
from osfcore.world.tabletop import Tabletop

# Variations of videos while FitVid learns: one random change of colours, the same for all frames.
#
# Deviations from the paper, which takes most operations of RandAugment (Cubuk et al., 2020): none that moves the
# image (crops, flips, rotations, shears, translations), for actions and places stay what they are and would then point
# elsewhere. The strength of a change is drawn, for the published program's fixed one leaves colour, contrast and
# brightness as they are. No equalisation of histograms. What an operation reads off the image, such as the mean grey
# that contrast is relative to, it reads off the whole video.


_STRENGTH = 0.3  # by which colour, contrast, brightness and sharpness are changed at most
_BITS = (5, 9)  # of colours after posterisation: the first, and the one after the last
_GREY = (0.299, 0.587, 0.114)

Frames = Float[Tensor, "T 3 h w"]


def augmented(videos: Float[Tensor, "B T 3 h w"], rng: np.random.Generator) -> Float[Tensor, "B T 3 h w"]:
    """Vary each video by a change of colours of its own.

    Args:
        videos: in [0, 1].
        rng: draws the changes.

    Returns:
        Videos in [0, 1].
    """
    return torch.stack([_recoloured(video, rng).clamp(0, 1) for video in videos])


def _recoloured(video: Frames, rng: np.random.Generator) -> Frames:
    """Change one thing: colour, contrast, brightness, sharpness, the range of each colour, or the number of levels."""
    match rng.integers(6):
        case 0:
            plain = _grey(video)
        case 1:
            plain = _grey(video).mean()
        case 2:
            plain = video.new_zeros(())
        case 3:
            kernel = video.new_tensor([[1, 1, 1], [1, 5, 1], [1, 1, 1]]) / 13
            padded = functional.pad(video, (1, 1, 1, 1), mode="replicate")
            plain = functional.conv2d(padded, kernel.expand(3, 1, 3, 3), groups=3)
        case 4:  # each colour stretched so that it spans everything from 0 to 1
            low, high = video.amin(dim=(0, 2, 3), keepdim=True), video.amax(dim=(0, 2, 3), keepdim=True)
            return torch.where(high > low, (video - low) / (high - low).clamp(min=1e-6), video)
        case _:
            levels = 2 ** int(rng.integers(*_BITS)) - 1
            return (video * levels).round() / levels
    return plain + (1 + rng.uniform(-_STRENGTH, _STRENGTH)) * (video - plain)


def _grey(video: Frames) -> Float[Tensor, "T 1 h w"]:
    return (video * video.new_tensor(_GREY)[:, None, None]).sum(dim=1, keepdim=True)


# Recorded pushes as videos.


LEAST_STEPS = 2  # of an episode: two frames of context, and one to predict


class Video(NamedTuple):
    """An episode of T actions.

    Attributes:
        frames: before the first and after each action.
        actions: [m/s].
        pushers: places of the pusher in the frames [m].
        names: of its objects.
    """

    frames: UInt8[Tensor, "T1 h w 3"]
    actions: Float32[Tensor, "T 3"]
    pushers: Float32[Tensor, "T1 2"]
    names: tuple[str, ...]


class Videos(NamedTuple):
    """What there is to learn from, and to measure on.

    Attributes:
        side: of the frames [px].
        learned: episodes to learn from.
        held_out: episodes to measure on.
    """

    side: int
    learned: list[Video]
    held_out: list[Video]


def read_videos(paths: Sequence[Path], side: int | None = None, device: torch.device | str = "cpu") -> Videos:
    """Read push files with frames: at 128 pixels a thousand episodes of 50 actions take 2.5 GB of memory.

    As for dynamics, one episode in twelve of each file is held out, and so is every other one in which a pair of
    objects meets that shall not be learned from.

    Args:
        paths: of the files.
        side: to which frames are averaged down [px]; as they are recorded if None.
        device: that holds them.

    Raises:
        CorruptFile: if one is no push file, or has no frames.
        InvalidInput: if frames differ in size between files or cannot be averaged down to that side, or nothing is left
            to learn from or to measure on.
    """
    learned: list[Video] = []
    held_out: list[Video] = []
    for path in paths:
        for number, episode in enumerate(read_sound_pushes(path)):
            if is_for_validation(number):
                held_out.append(_video(path, episode, side, device))
            elif not has_held_out_pair(episode.names):
                learned.append(_video(path, episode, side, device))
    sides = sorted({len(video.frames[0]) for video in (*learned, *held_out)})
    if len(sides) > 1:
        raise InvalidInput("sizes of the frames [px]", sides, "the same in all files")
    for what, videos in (("learn from", learned), ("measure on", held_out)):
        if not videos:
            raise InvalidInput(f"episodes with frames to {what}", 0, "at least 1: collect more")
    return Videos(sides[0], learned, held_out)


def _video(path: Path, episode: PushEpisode, side: int | None, device: torch.device | str) -> Video:
    frames = episode.frames
    if frames is None:
        raise CorruptFile(path, "it holds no frames: 'osf collect pushes --images' keeps them")
    if frames.dtype != np.uint8 or frames.shape[1] != frames.shape[2]:
        raise CorruptFile(path, f"its frames are {frames.dtype} of shape {frames.shape}, not square 8-bit images")
    if len(episode.actions) < LEAST_STEPS:
        few = f"its episodes have {len(episode.actions)} actions, but {LEAST_STEPS} are needed to predict any"
        raise CorruptFile(path, few)
    images = torch.as_tensor(frames)
    if side is not None and side != frames.shape[1]:
        if side > frames.shape[1] or frames.shape[1] % side:
            raise InvalidInput(
                "side of the frames [px]", side, f"one that divides {frames.shape[1]}, their recorded one"
            )
        pooled = functional.avg_pool2d(images.movedim(-1, 1).float(), frames.shape[1] // side)
        images = pooled.round().byte().movedim(1, -1).contiguous()
    given = (torch.as_tensor(one, dtype=torch.float32) for one in (episode.actions, episode.pusher[:, :2]))
    actions, pushers = (one.to(device) for one in given)
    return Video(images.to(device), actions, pushers, episode.names)


class Windows(NamedTuple):
    """B stretches of T actions.

    Attributes:
        frames: before the first and after each action, in [0, 1].
        actions: [m/s].
        pushers: places of the pusher in the frames [m].
    """

    frames: Float[Tensor, "B T1 3 h w"]
    actions: Float32[Tensor, "B T 3"]
    pushers: Float32[Tensor, "B T1 2"]


def windows(videos: Sequence[Video], starts: Int[np.ndarray, "B"], steps: int) -> Windows:
    """Return stretches of the same length as the network takes them.

    Args:
        videos: one episode for each stretch.
        starts: first action of each stretch.
        steps: actions in each.
    """
    chosen = list(zip(videos, starts.tolist(), strict=True))
    frames = torch.stack([video.frames[start : start + steps + 1] for video, start in chosen])
    actions = torch.stack([video.actions[start : start + steps] for video, start in chosen])
    pushers = torch.stack([video.pushers[start : start + steps + 1] for video, start in chosen])
    return Windows(frames.movedim(-1, 2).float() / 255, actions, pushers)


def draw_windows(videos: Sequence[Video], rng: np.random.Generator, count: int, steps: int) -> Windows:
    """Draw random stretches of random episodes.

    Args:
        videos: the episodes.
        rng: draws them.
        count: of them.
        steps: actions in each.

    Raises:
        InvalidInput: if no episode is so long.
    """
    long = [video for video in videos if len(video.actions) >= steps]
    if not long:
        longest = max(len(video.actions) for video in videos)
        raise InvalidInput("frames of a window", steps + 1, f"at most {longest + 1}, as the longest episode has")
    chosen = [long[n] for n in rng.integers(len(long), size=count)]
    return windows(chosen, rng.integers([len(video.actions) - steps + 1 for video in chosen]), steps)


# How well held-out videos are predicted, step by step, against the last context frame, copied.


HORIZONS = (10, 30)  # predicted steps
_AT_ONCE = 8  # videos


@dataclass(frozen=True, eq=False, slots=True)
class VideoErrors:
    """Errors of N videos at T predicted steps.

    Attributes:
        predicted: mean squared error over the pixels of each frame.
        copied: the same if nothing ever changed after the context.
    """

    predicted: Float[np.ndarray, "N T"]
    copied: Float[np.ndarray, "N T"]

    def report(self) -> dict[str, Any]:
        """Return means over each horizon that the videos are long enough for, and by step, as plain JSON."""
        steps = self.predicted.shape[1]
        shown = [horizon for horizon in HORIZONS if horizon <= steps] or [steps]
        return {
            "videos": len(self.predicted),
            "horizons": {str(horizon): self._means(slice(horizon)) for horizon in shown},
            "steps": [self._means(slice(step, step + 1)) for step in range(steps)],
        }

    def _means(self, steps: slice) -> dict[str, float]:
        """Return means of errors, and of each frame's own PSNR [dB]."""
        report = {}
        for name, errors in (("", self.predicted[:, steps]), ("_copied", self.copied[:, steps])):
            psnr = np.minimum(-10 * np.log10(np.maximum(errors, 1e-12)), MOST_DB)
            report |= {f"mse{name}": round(float(errors.mean()), 7), f"psnr{name}": round(float(psnr.mean()), 3)}
        return report


def measure(model: FitVidModel, videos: Sequence[Video]) -> Iterator[VideoErrors]:
    """Predict the beginnings of videos with the prior's means; yields what there is after each few of them.

    Args:
        model: in evaluation mode.
        videos: as far as the longest horizon, or as the shortest of them goes.

    """
    steps = min(*(len(video.actions) for video in videos), CONTEXT - 1 + max(HORIZONS))
    predicted, copied = [], []
    for first in range(0, len(videos), _AT_ONCE):
        some = videos[first : first + _AT_ONCE]
        frames, actions, pushers = windows(some, np.zeros(len(some), int), steps)
        futures = model.rollout(frames[:, :CONTEXT], actions, pushers)
        last, truths = frames[:, CONTEXT - 1], frames[:, CONTEXT:].unbind(dim=1)
        predicted.append(_errors(list(futures), truths))
        copied.append(_errors([last] * len(truths), truths))
        yield VideoErrors(np.concatenate(predicted), np.concatenate(copied))


def _errors(images: Sequence[Tensor], truths: Sequence[Tensor]) -> Float[np.ndarray, "B T"]:
    """Return the mean squared error of each image of B videos at T steps."""
    errors = [(image - truth).square().mean(dim=(1, 2, 3)) for image, truth in zip(images, truths, strict=True)]
    return np.stack([error.cpu().numpy().astype(float) for error in errors], axis=1)


# How much actions matter: a network that ignores them predicts the same after opposite pushes.


_PUSHED_STEPS, _PUSHED_M_S = 10, 0.1
_CLEARANCE_M = 0.02  # between pusher and object before the push


def action_effect(
    model: FitVidModel, library: AssetLibrary, names: Sequence[str], scenes: int = 12, seed: int = 0
) -> dict[str, float]:
    """Measure by how much the tenth frames after two opposite pushes differ, as predicted and in truth.

    In each scene the pusher stands beside one object, under a random light, and is driven through it or away from it.

    Args:
        model: in evaluation mode.
        library: meshes of the objects.
        names: of the objects, one of which is drawn for each scene.
        scenes: over which means are taken.
        seed: of the scenes.

    Returns:
        Means over pixels, colours and scenes of the absolute difference "predicted" and "true" [0 to 1].
    """
    camera, predicted, true = (goal_camera(model.settings.side),), [], []
    with closing(Tabletop(library, request=SceneRequest(count=1, among=tuple(names)))) as world:
        for number in range(scenes):
            rng = stream_rng(seed, Stream.VIDEO_SCENE, number)
            world.arrange(int(rng.integers(2**31)))
            start, angle = world.truth(), rng.uniform(0, 2 * np.pi)
            way = np.array([np.cos(angle), np.sin(angle), 0.0])
            gap = np.hypot(*library.size_m(start.names[0])[:2]) / 2 + PUSHER_RADIUS_M + _CLEARANCE_M
            place = start.poses.position[0] - gap * way
            pusher = np.array([*place[:2], PUSHER_CENTRE_Z_M])
            start = replace(start, pusher=pusher)
            pushes = np.tile(_PUSHED_M_S * way, (2, _PUSHED_STEPS, 1)) * np.array([1, -1])[:, None, None]
            world.restore(start)
            before, ends = world.render(camera).images[0], []
            for actions in pushes:
                world.restore(start)
                for action in actions:
                    world.act(action)
                ends.append(world.render(camera).images[0])
            futures = model.predict(np.stack([before, before]), pushes, pusher)[:, -1]
            predicted.append(float(np.abs(futures[0] - futures[1]).mean()))
            true.append(float(np.abs(ends[0] - ends[1]).mean()))
    return {"predicted": round(float(np.mean(predicted)), 6), "true": round(float(np.mean(true)), 6)}


_CLIP = 100.0
_FALLING = 0.2  # of the budget
_RECENT = 0.9  # share of running means that is kept from step to step
_OWN_METRICS = ("parameters", "horizons")
Precision = Literal["bfloat16", "float32"]


@dataclass(frozen=True, slots=True)
class TrainFitVid:
    """A training run.

    Attributes:
        data: push files with frames; one in twelve episodes is held out.
        out: file to write, FILE.safetensors; metrics go beside it to FILE.json.
        minutes: how long to train [min], without reading at the beginning and measuring at the end.
        iterations: instead of a time budget: that many steps of descent, repeatable on one machine.
        side: of the images [px], to which recorded frames are averaged down; as they are if None.
        width: channels at full size.
        batch: windows in each step.
        frames: of a window, context included.
        rate: of learning.
        warm_up: steps over which the rate rises from nothing.
        beta: weight of the KL divergence.
        decoded: frames of each window whose images count in a step, drawn anew.
        augment: whether videos are varied.
        precision: what convolutions compute in while training.
        save_every: steps between checkpoints.
        measured: held-out videos to measure on in the end, at most.
        device: "auto", "cpu" or "cuda".
        seed: of everything random.
    """

    data: tuple[Path, ...]
    out: Path
    minutes: float = 60.0
    iterations: int | None = None
    side: int | None = None
    width: int = 4
    batch: int = 8
    frames: int = 12
    rate: float = 2e-3
    warm_up: int = 200
    beta: float = 1e-4
    decoded: int = 4
    augment: bool = True
    precision: Precision = "bfloat16"
    save_every: int = 20
    measured: int = 32
    device: Literal["auto", "cpu", "cuda"] = "auto"
    seed: int = 0

    @property
    def command(self) -> str:
        """The command that does it again."""
        parts = ["osf", "train", "fitvid", "--data", *(path.name for path in self.data), "--out", self.out.name]
        for field in fields(self):
            value = getattr(self, field.name)
            if field.name in ("data", "out", "device") or value == field.default:
                continue
            name = field.name.replace("_", "-")
            parts += [f"--no-{name}"] if value is False else [f"--{name}", str(value)]
        return shlex.join(parts)


def train_fitvid(config: TrainFitVid, library: AssetLibrary | None = None) -> Iterator[Progress]:
    """Train a network and write it; a killed run goes on from its last checkpoint.

    Args:
        config: what to learn from, and how.
        library: meshes of the objects, for `action_effect` in the metrics, which is null without.

    Yields:
        Seconds of the budget (or steps).

    Raises:
        InvalidInput: if a number is out of range, the device is not there, or nothing is left to learn from.
        CorruptFile: if a push file cannot be read or has no frames, or the checkpoint of a killed run cannot be gone on
            from.
        CannotWrite: if the output cannot be written, which is tried first.
    """
    check_seed(config.seed)
    if config.precision not in ("bfloat16", "float32"):
        raise InvalidInput("precision", repr(config.precision), '"bfloat16" or "float32"')
    check_ranges(
        ("minutes", config.minutes, 0.01, 7 * 24 * 60),
        ("iterations", 1 if config.iterations is None else config.iterations, 1, 10_000_000),
        ("side of the images [px]", 16 if config.side is None else config.side, 16, 1024),
        ("width of the network", config.width, 1, 256),
        ("batch", config.batch, 1, 10_000),
        ("frames of a window", config.frames, CONTEXT + 1, 1000),
        ("rate of learning", config.rate, 1e-9, 1),
        ("steps of warm-up", config.warm_up, 0, 1_000_000),
        ("beta", config.beta, 0, 1e6),
        ("decoded frames", config.decoded, 1, 1000),
        ("steps between checkpoints", config.save_every, 1, 1_000_000),
        ("held-out videos", config.measured, 1, 1_000_000),
    )
    device = pick_device(config.device)
    check_weights_place(config.out, _OWN_METRICS)
    run = _Run(config, read_videos(config.data, config.side, device), device)
    run.resume()
    yield run.progress("Reading the frames")
    while run.share < 1:
        note = run.iterate()
        if run.steps % config.save_every == 0:
            run.save()
        yield run.progress(note)
    run.save()  # a kill while it measures repeats no step
    yield from run.finish(library)


class _Run:
    """The state of a training run."""

    def __init__(self, config: TrainFitVid, videos: Videos, device: torch.device) -> None:
        self._config, self._videos, self._device = config, videos, device
        generator = torch.random.get_rng_state()
        torch.manual_seed(stream_seed(config.seed, Stream.VIDEO_WEIGHTS))
        self._model = FitVidModel(FitVidSettings(videos.side, config.width), getattr(torch, config.precision))
        torch.random.set_rng_state(generator)
        self._model.to(device)
        self._adam = torch.optim.Adam(self._model.parameters(), config.rate)
        self.steps, self._spent_s = 0, 0.0
        self._recent: dict[str, float] = {}

    @property
    def share(self) -> float:
        """Share of the budget that is spent."""
        if self._config.iterations is not None:
            return self.steps / self._config.iterations
        return self._spent_s / (60 * self._config.minutes)

    def progress(self, note: str) -> Progress:
        """Return the progress in seconds, or in steps."""
        total = self._config.iterations or max(1, round(60 * self._config.minutes))
        return Progress(min(round(self.share * total), total), total, note)

    def iterate(self) -> str:
        """Do one step of descent. What is random in it depends on its number alone, not on the steps before it."""
        began, config = time.monotonic(), self._config
        rng = stream_rng(config.seed, Stream.VIDEO_WINDOWS, self.steps)
        frames, actions, pushers = draw_windows(self._videos.learned, rng, config.batch, config.frames - 1)
        if config.augment:
            frames = augmented(frames, rng)
        latents = torch.Generator(self._device).manual_seed(int(rng.integers(2**62)))
        steps = config.frames - 1
        decoded = sorted(rng.choice(steps, min(config.decoded, steps), replace=False).tolist())
        losses = self._model.losses(frames, actions, pushers, latents, decoded)
        self._adam.zero_grad(set_to_none=True)
        (losses.squared_error + config.beta * losses.kl).backward()
        norm = torch.nn.utils.clip_grad_norm_(self._model.parameters(), _CLIP)
        rising = (self.steps + 1) / max(config.warm_up, 1)
        for group in self._adam.param_groups:
            group["lr"] = config.rate * min(1.0, rising, max((1 - self.share) / _FALLING, 1e-3))
        still = (frames[:, CONTEXT:] - frames[:, CONTEXT - 1 : CONTEXT]).square().mean() * (config.frames - 1)
        # one transfer from the device, for each waits until it has done the step
        *sums, length = torch.stack([*losses, still, norm]).detach().tolist()
        if math.isfinite(length):  # else this step would spoil all that follow
            self._adam.step()
        means = (*(total / (config.frames - 1) for total in sums), length)
        for name, value in zip(("error", "kl", "still", "norm"), means, strict=True):
            self._recent[name] = value + _RECENT * (self._recent.get(name, value) - value)
        self.steps += 1
        self._spent_s += time.monotonic() - began
        error, still, kl = (self._recent[name] for name in ("error", "still", "kl"))
        return f"step {self.steps}: MSE {error:.5f}, of a copied frame {still:.5f}; KL {kl:.2f}"

    @property
    def _checkpoint(self) -> Path:
        return self._config.out.with_suffix(".checkpoint")

    def _fingerprint(self) -> str:
        free = {"out": "", "device": "", "save_every": 0, "measured": 0, "minutes": 0.0, "iterations": 0}
        settings = {**asdict(self._config), **free, "data": [path.name for path in self._config.data]}
        return repr((settings, self._videos.side, len(self._videos.learned)))

    def save(self) -> None:
        """Write everything that is needed to go on, also with a larger budget."""
        content = {"model": self._model.state_dict(), "adam": self._adam.state_dict()}
        numbers = {"steps": self.steps, "spent_s": self._spent_s, "recent": self._recent}
        write_checkpoint(self._checkpoint, self._fingerprint(), {**content, **numbers})

    def resume(self) -> None:
        """Go on from the checkpoint of the same run, if there is one."""
        resume_from(self._checkpoint, self._fingerprint(), self._restore)

    def _restore(self, content: dict[str, Any]) -> None:
        self._model.load_state_dict(content["model"])
        self._adam.load_state_dict(content["adam"])
        self.steps, self._spent_s, self._recent = content["steps"], content["spent_s"], content["recent"]

    def finish(self, library: AssetLibrary | None) -> Iterator[Progress]:
        """Measure on held-out videos, and write weights and metrics."""
        model, videos = self._model.eval(), self._videos.held_out[: self._config.measured]
        errors = None
        for errors in measure(model, videos):
            yield self.progress(f"Measuring on held-out videos ({len(errors.predicted)} of {len(videos)})")
        assert errors is not None  # for the type checker: there are held-out videos
        report = errors.report()
        write_fitvid(self._config.out, model)
        names = sorted({name for video in self._videos.learned for name in video.names})
        there = [] if library is None else [name for name in names if library.has(name)]
        own = {
            "command": self._config.command,
            "seed": self._config.seed,
            "data": [path.name for path in self._config.data],
            "parameters": model.parameter_count,
            "bytes": self._config.out.stat().st_size,
            "minutes": round(self._spent_s / 60, 2),
            "iterations": self.steps,
            "episodes": len(self._videos.learned),
            "device": str(self._device),
            "threads": torch.get_num_threads(),
            "training_mse": round(self._recent.get("error", 0.0), 7),
            "training_mse_copied": round(self._recent.get("still", 0.0), 7),
            "training_kl": round(self._recent.get("kl", 0.0), 4),
            "gradient_norm": round(self._recent.get("norm", 0.0), 4),
            "action_effect": action_effect(model, library, there) if library is not None and there else None,
        }
        write_json(self._config.out.with_suffix(".json"), {**own, **report})
        self._checkpoint.unlink(missing_ok=True)
        horizon, means = list(report["horizons"].items())[-1]
        copied = f"copied: {means['psnr_copied']:.1f} dB"
        yield self.progress(f"held out: {means['psnr']:.1f} dB over {horizon} steps ({copied})")
