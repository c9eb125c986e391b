"""Training a KiloOSF straight from images, cameras, lights and silhouettes: a coarse solid first, then a fine shell.

Phases share the time budget. Recipe "direct": the visual hull of the silhouettes becomes a coarse field, which learns
until it knows where surfaces are (also those that no silhouette shows); the corners that some pixel sees are kept on a
fine grid, which learns the rest. Recipe "distil", the paper's: an OSF learns from the images, a fine field learns from
it, and then from the images. A checkpoint beside the output lets the same command go on after it was killed.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
import torch
from jaxtyping import UInt8

from osfcore.errors import CorruptFile, InvalidInput, check_seed
from osfcore.fields.devices import pick_device
from osfcore.fields.field_weights import field_bytes, field_from_bytes
from osfcore.fields.kiloosf import KiloOSF, without_light
from osfcore.fields.osf import OSF, OSFSize
from osfcore.fields.ray_sampling import RaySource
from osfcore.fields.training.checkpoint import Checkpoint, read_checkpoint, write_checkpoint
from osfcore.fields.training.distillation import Distillation, first_student
from osfcore.fields.training.network_stage import NetworkHoldout, NetworkStage
from osfcore.fields.training.optimization import Stage
from osfcore.fields.training.osf_training import TeacherRecipe, first_teacher, restored_teacher
from osfcore.fields.training.photo_consistency import open_hollows, without_fog
from osfcore.fields.training.recipes import Pace, Recipe, TrainField
from osfcore.fields.training.validation import Holdout
from osfcore.fields.training.visual_hull import silhouette_box
from osfcore.fields.training.voxel_fit import fit_voxels
from osfcore.fields.voxel_shell import first_shell, refine, trim
from osfcore.io.files import write_atomically, write_json
from osfcore.io.image_set import ImageSet, read_splits
from osfcore.io.output_paths import check_weights_place
from osfcore.io.training_checkpoint import going_on_from
from osfcore.progress import Progress

_AIMED_BYTES = 2_000_000
_NEEDED_WEIGHTS = (0.02, 0.05, 0.1, 0.2)  # of samples that a view must show, tried until the file is small enough
_OWN_METRICS = ("psnr_full", "psnr_mask")  # by which a file of metrics is known
_LOOK_SHARE = 0.05  # of the budget between two looks at held-out images
_MIN_LOOK_S = 5.0
_TRANSITIONS = {"distil": "Baking the teacher into a shell", "fine": "Refining the shell"}
_Learner = Stage | NetworkStage  # a phase between its steps: step, snapshot, state


@dataclass(frozen=True, eq=False, slots=True)
class FieldStep:
    """How far training is.

    Attributes:
        progress: in seconds of the budget (or steps), with PSNR and time left in words.
        psnr_full: on held-out images, over black [dB]; None until measured.
        psnr_mask: the same inside the silhouettes, dilated by 2 px [dB].
        preview: one held-out image: truth, ours, difference x 4; None between looks.
    """

    progress: Progress
    psnr_full: float | None
    psnr_mask: float | None
    preview: UInt8[np.ndarray, "h w3 3"] | None


def train_field(config: TrainField, recipe: Recipe | None = None, pace: Pace | None = None) -> Iterator[FieldStep]:
    """Train a field from an image set and write it.

    Raises:
        InvalidInput: if the settings are out of range, cuda is asked for and not there, or a file of somebody else lies
            where the metrics belong.
        CorruptFile: if the image set is not sound, nothing of the object could be learned, or the checkpoint of a
            killed run cannot be gone on from.
        CannotWrite: if the output cannot be written, which is tried first.
    """
    device = pick_device(config.device)
    _check(config)
    recipe = recipe or Recipe()
    yield FieldStep(Progress(0, _total(config), "Reading the images"), None, None, None)
    train, test = read_splits(config.data)
    if train.is_opaque:
        expected = "an object before a transparent background is expected (opaque sets show the bare table)"
        raise CorruptFile(config.data, f"its images are opaque all over; {expected}")
    if not config.lit:  # l = 0 leaves n . l and the networks' weights for l without a gradient
        train, test = (replace(part, light_directions=np.zeros_like(part.light_directions)) for part in (train, test))
    yield from _Run(config, recipe, pace or Pace(), device, train, test).steps()


def _check(config: TrainField) -> None:
    if not 0.05 <= config.minutes <= 24 * 60:
        raise InvalidInput("minutes", config.minutes, "between 0.05 and 1440")
    if config.recipe not in ("direct", "distil"):
        raise InvalidInput("recipe", config.recipe, "direct or distil")
    if config.recipe == "distil" and not config.lit:
        raise InvalidInput("recipe of a field without light", config.recipe, "direct")
    OSFSize(config.teacher_depth, config.teacher_width)  # refuses what cannot be built
    check_seed(config.seed)
    if config.iterations is not None and not 10 <= config.iterations <= 10_000_000:
        raise InvalidInput("iterations", config.iterations, "between 10 and 10,000,000")
    check_weights_place(config.out, _OWN_METRICS)


def _total(config: TrainField) -> int:
    return config.iterations or max(1, round(config.minutes * 60))


class _Run:
    """The state of one training run between its steps."""

    def __init__(
        self, config: TrainField, recipe: Recipe, pace: Pace, device: torch.device, train: ImageSet, test: ImageSet
    ) -> None:
        self._config, self._recipe, self._pace, self._device = config, recipe, pace, device
        self._images, self._source = train, RaySource(train)
        self._pixels = self._source.silhouette_pixels()
        self._test, self._holdout = test, Holdout(test)
        self._digests = [train.digest(), test.digest()]
        self._rng = np.random.default_rng(config.seed)
        self._generator = torch.Generator(device).manual_seed(config.seed)
        self._done_s, self._done_steps = 0.0, 0
        self._psnr: tuple[float, float] | None = None
        self._looked_at = 0.0

    def steps(self) -> Iterator[FieldStep]:
        saved = read_checkpoint(self._checkpoint_path, self._fingerprint())
        phases = self._phases()
        if saved is not None:
            with going_on_from(self._checkpoint_path):
                name, learner = saved.stage, self._resumed(saved)
            yield self._report("Going on from a checkpoint")
        else:
            yield self._report("Carving the silhouettes")
            name, learner = next(iter(phases)), self._first()
        names = list(phases)
        for number in range(names.index(name), len(names)):
            if number > names.index(name):
                yield self._report(_TRANSITIONS[names[number]])
                learner = self._next(names[number], learner)
                self._save(names[number], learner)
            start = phases[names[number - 1]] if number else 0.0
            yield from self._descend(names[number], learner, start, phases[names[number]])
        yield self._report("Measuring on all held-out images")
        yield self._finish(learner.snapshot())

    def _phases(self) -> dict[str, float]:
        """Names of the phases, in order, and the share of the budget at which each ends."""
        r = self._recipe
        if self._config.recipe == "direct":
            return {"coarse": r.hollow_share if self._config.hollow else r.coarse_share, "fine": 1.0}
        return {"teacher": r.teacher_share, "distil": r.teacher_share + r.distil_share, "fine": 1.0}

    def _first(self) -> _Learner:
        box = silhouette_box(self._images, where=self._config.data)
        r = self._recipe
        if self._config.recipe == "distil":
            return first_teacher(self._images, box, self._teacher_recipe(), self._rng, self._device)
        across = r.hollow_across if self._config.hollow else r.coarse_across
        field = first_shell(self._images, box, across=across, cells=r.cells, hidden=r.hidden,
                            inside_g=r.solid_g, rng=self._rng)  # fmt: skip
        if self._config.hollow:
            field = open_hollows(field, self._images, fog_g=r.hollow_g)
            field = without_fog(fit_voxels(field, self._images, steps=r.hollow_steps, rays=r.rays, rng=self._rng))
        return self._stage("coarse", field)

    def _stage(self, name: str, field: KiloOSF) -> Stage:
        r = self._recipe
        return Stage(field, r.coarse_rates if name == "coarse" else r.fine_rates, self._device)

    def _next(self, name: str, before: _Learner) -> _Learner:
        """The learner of a phase, from that of the phase before."""
        r = self._recipe
        if name == "distil":
            assert isinstance(before, NetworkStage)
            osf = before.network
            assert isinstance(osf, OSF)
            student = first_student(osf, before.snapshot(), self._images, across=r.fine_across, cells=r.cells,
                                    hidden=r.hidden, rng=self._rng)  # fmt: skip
            return Distillation(student, osf, self._device)
        field = before.snapshot()
        if not isinstance(before, Distillation):
            field = refine(field, self._images, across=r.fine_across, rng=self._rng)
        return self._stage(name, field)

    def _teacher_recipe(self) -> TeacherRecipe:
        return TeacherRecipe(OSFSize(self._config.teacher_depth, self._config.teacher_width))

    def _share(self) -> float:
        """Of the whole budget that is used up."""
        if self._config.iterations is not None:
            return min(1.0, self._done_steps / self._config.iterations)
        return min(1.0, self._done_s / (60 * self._config.minutes))

    def _descend(self, name: str, stage: _Learner, start: float, end: float) -> Iterator[FieldStep]:
        clock, already = self._pace.clock, self._done_s
        began = reported = saved = clock()
        while (share := self._share()) < end:
            count = self._teacher_recipe().rays if isinstance(stage, NetworkStage) else self._recipe.rays
            rays = self._source.batch(self._rng.choice(self._pixels, count))
            stage.step(rays, (share - start) / (end - start), self._rng, self._generator)
            self._done_steps += 1
            now = clock()
            self._done_s = already + now - began
            if now - reported > self._pace.report_s:
                reported = now
                yield self._look(stage)
            if now - saved > self._pace.checkpoint_s:
                saved = now
                self._save(name, stage)
            began += clock() - now  # looking and saving cost nobody's budget

    def _look(self, stage: _Learner) -> FieldStep:
        budget_s = 60 * self._config.minutes
        preview = None
        if self._done_s - self._looked_at > max(_MIN_LOOK_S, _LOOK_SHARE * budget_s):
            self._looked_at = self._done_s
            holdout = NetworkHoldout(self._test, stage.network) if isinstance(stage, NetworkStage) else self._holdout
            look = holdout.glance(stage.snapshot())
            self._psnr, preview = (look.psnr_full, look.psnr_mask), look.preview
        return replace(self._report(""), preview=preview)

    def _report(self, words: str) -> FieldStep:
        total = _total(self._config)
        share = self._share()
        full, mask = self._psnr or (None, None)
        if not words:
            left_s = self._done_s * (1 / share - 1) if share else 0.0
            quality = f"{full:.1f} dB held out ({mask:.1f} in the mask), " if full is not None else ""
            words = f"{quality}{_duration(left_s)} left"
        return FieldStep(Progress(round(share * total), total, words), full, mask, None)

    def _finish(self, field: KiloOSF) -> FieldStep:
        """Measure what users will read from the file, and write it once it is known to be sound."""
        out = self._config.out
        data = self._trimmed(field)
        look = self._holdout.everything(field_from_bytes(data, "The trained field"))
        metrics = {
            "psnr_full": round(look.psnr_full, 3),
            "psnr_mask": round(look.psnr_mask, 3),
            "test_images": look.images,
            "bytes": len(data),
            "minutes": round(self._done_s / 60, 3),
            "iterations": self._done_steps,
            "seed": self._config.seed,
            "device": str(self._device),
            "threads": torch.get_num_threads(),
            "data": self._config.data.name,
            "train_images": len(self._images.cameras),
            "image_size": list(self._source.image_shape),
            "hollow": self._config.hollow,
            "lit": self._config.lit,
            "recipe": {"name": self._config.recipe, **asdict(self._recipe)},
        }
        if self._config.recipe == "distil":
            metrics["teacher"] = asdict(self._teacher_recipe())
        write_atomically(out, data)
        write_json(out.with_suffix(".json"), metrics)
        self._checkpoint_path.unlink(missing_ok=True)
        self._psnr = look.psnr_full, look.psnr_mask
        words = f"{look.psnr_full:.2f} dB held out, {look.psnr_mask:.2f} dB in the mask, {len(data) / 1e6:.2f} MB"
        total = _total(self._config)
        return FieldStep(Progress(total, total, words), look.psnr_full, look.psnr_mask, look.preview)

    def _trimmed(self, field: KiloOSF) -> bytes:
        """The field as a file of at most the size aimed at, if leaving out what hardly shows can make it so."""
        data = b""
        field = field if self._config.lit else without_light(field)
        for needed_weight in _NEEDED_WEIGHTS:
            data = field_bytes(trim(field, self._images, needed_weight))
            if len(data) <= _AIMED_BYTES:
                break
        return data

    @property
    def _checkpoint_path(self) -> Path:
        return self._config.out.with_suffix(".partial")

    def _fingerprint(self) -> dict[str, Any]:
        """What a checkpoint must agree with to be gone on from."""
        settings = {**asdict(self._config), "data": str(self._config.data.resolve()), "out": str(self._config.out)}
        return {"settings": settings, "recipe": asdict(self._recipe), "images": self._digests}

    def _save(self, name: str, stage: _Learner) -> None:
        clock = {"seconds": self._done_s, "steps": self._done_steps, "looked_at": self._looked_at, "psnr": self._psnr}
        random = {"numpy": self._rng.bit_generator.state, "torch": self._generator.get_state()}
        checkpoint = Checkpoint(name, stage.snapshot(), stage.state(), clock, random)
        write_checkpoint(self._checkpoint_path, checkpoint, self._fingerprint())

    def _resumed(self, saved: Checkpoint) -> _Learner:
        if saved.stage == "teacher":
            learner = restored_teacher(saved.field, saved.optimiser, self._teacher_recipe(), self._device)
        elif saved.stage == "distil":
            learner = Distillation.restored(saved.field, saved.optimiser, self._teacher_recipe().size, self._device)
        else:
            learner = self._stage(saved.stage, saved.field)
            learner.restore(saved.optimiser)
        self._done_s, self._done_steps = saved.clock["seconds"], saved.clock["steps"]
        self._looked_at, self._psnr = saved.clock["looked_at"], saved.clock["psnr"]
        self._rng.bit_generator.state = saved.random["numpy"]
        self._generator.set_state(saved.random["torch"])
        return learner


def _duration(seconds: float) -> str:
    minutes, rest = divmod(round(seconds), 60)
    return f"{minutes} min {rest} s" if minutes else f"{rest} s"
