"""Training a KiloOSF straight from images, cameras, lights and silhouettes: a coarse solid first, then a fine shell.

Phases share the time budget. Recipe "direct": the visual hull of the silhouettes becomes a coarse field, which learns
until it knows where surfaces are (also those that no silhouette shows); the corners that some pixel sees are kept on a
fine grid, which learns the rest. Recipe "distil", the paper's: an OSF learns from the images, a fine field learns from
it, and then from the images. A checkpoint beside the output lets the same command go on after it was killed.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Any, Literal

import numpy as np
import torch
from jaxtyping import Float, Float32, UInt8
from scipy import ndimage
from torch import Tensor

from osfcore.errors import CorruptFile, InvalidInput, check_seed
from osfcore.fields.devices import pick_device
from osfcore.fields.hollow import fit_voxels, open_hollows, without_fog
from osfcore.fields.kiloosf import (
    EMPTY_G,
    FEATURES,
    FLOOR_G,
    STEP_VOXELS,
    KiloOSF,
    field_bytes,
    field_from_bytes,
    without_light,
)
from osfcore.fields.osf import OSF, OSFSize
from osfcore.fields.rays import (
    FIRST_NORMAL,
    RayBatch,
    RaySource,
    first_shell,
    march,
    refine,
    reshelled,
    seen_corners,
    trim,
)
from osfcore.fields.train_osf import (
    Checkpoint,
    Holdout,
    NetworkStage,
    Rates,
    Stage,
    TeacherRecipe,
    baked_g,
    check_budget,
    corners,
    first_teacher,
    restored_teacher,
)
from osfcore.fields.visual_hull import silhouette_box
from osfcore.fields.volume_rendering import alphas_from_thickness
from osfcore.io.checkpoint import going_on_from
from osfcore.io.files import write_atomically, write_json
from osfcore.io.image_set import ImageSet, read_splits
from osfcore.io.output_paths import check_weights_place
from osfcore.progress import Progress

# From an OSF to a KiloOSF: the second of the paper's three steps; fine-tuning on images follows.
#
# The teacher's density is baked into the corners of a fine grid, which gives the shell; then albedo, dipoles,
# ambient light and the tiny networks learn to answer as the teacher does at random points near the surface. Lights
# and views are drawn from those that the images have, each light turned a little: elsewhere a teacher knows nothing
# (the published recipe asks it at lights that it never saw). Points lie along pixels' rays, so that no view comes
# from inside.


_DISTILLATION_RATES = Rates(2e-2, 5e-3)
_POINTS = 8192
_RAYS = 2048
_SPREAD_VOXELS = 1.0  # of the points around those that a ray meets
_LIGHT_TURN = 0.15  # standard deviation of what is added to a unit vector
_CELL_JITTER = 0.25
_REFRESH = 16  # iterations between looks at where surfaces are
_POINTS_AT_ONCE = 32_768


def first_student(
    osf: OSF, proposal: KiloOSF, images: ImageSet, *, across: int, cells: int, hidden: int, rng: np.random.Generator
) -> KiloOSF:
    """Make a field with the teacher's density and albedo, and dipoles across its surface.

    Args:
        osf: teacher.
        proposal: its density on a coarse grid.
        images: whose views decide which corners matter.
        across: voxels along the longest side.
        cells: tiny networks along the longest side.
        hidden: their width.
        rng: for the networks' first weights.
    """
    box = _occupied_box(osf, proposal)
    whole = first_shell(images, box, across=across, cells=cells, hidden=hidden, inside_g=0.0, rng=rng)
    places = corners(whole).reshape(-1, 3)
    inside = whole.index.ravel() > 0
    features = np.zeros((len(places), FEATURES), np.float32)
    features[:, 0] = EMPTY_G
    features[inside, 0] = baked_g(osf, places[inside], whole.voxel)
    solid = features[:, 0] > FLOOR_G
    features[:, 1:4] = 0.5
    features[solid, 1:4] = _albedo(osf, places[solid])
    features = features.reshape(*whole.index.shape, FEATURES)
    nearest = ndimage.distance_transform_edt(features[..., 0] <= FLOOR_G, return_distances=False, return_indices=True)
    features[..., 1:4] = features[(*np.asarray(nearest),)][..., 1:4]
    smooth = ndimage.gaussian_filter(features[..., 0], 1.0)
    normals = -np.moveaxis(np.asarray(np.gradient(smooth)), 0, -1)
    features[..., 4:7] = FIRST_NORMAL * normals / np.maximum(np.linalg.norm(normals, axis=-1, keepdims=True), 1e-6)
    whole = replace(whole, ambient=osf.ambient.detach().cpu().numpy().copy())
    seen = seen_corners(reshelled(whole, np.ones(whole.index.shape, bool), features), images, rng)
    return reshelled(whole, ndimage.binary_dilation(seen, iterations=2), features)


def _occupied_box(osf: OSF, proposal: KiloOSF) -> Float[np.ndarray, "2 3"]:
    """Return the box of all that the teacher's density reaches on the proposals' grid, and a voxel more [m]."""
    places = corners(proposal)[proposal.density > FLOOR_G]
    places = places[baked_g(osf, places, proposal.voxel) > FLOOR_G] if len(places) else places
    if not len(places):
        return proposal.box
    return np.stack([places.min(axis=0) - proposal.voxel, places.max(axis=0) + proposal.voxel])


@torch.no_grad()
def _albedo(osf: OSF, points: Float32[np.ndarray, "n 3"]) -> Float32[np.ndarray, "n 3"]:
    parts = np.array_split(points, max(1, len(points) // _POINTS_AT_ONCE))
    return torch.cat([osf.material_at(torch.as_tensor(p, device=osf.device))[1].cpu() for p in parts]).numpy()


class Distillation(Stage):
    """A KiloOSF while it learns from a teacher."""

    def __init__(self, field: KiloOSF, osf: OSF, device: torch.device) -> None:
        """Begin with a field's numbers and a trained teacher."""
        super().__init__(field, _DISTILLATION_RATES, device)
        self.osf = osf

    def step(self, rays: RayBatch, share: float, rng: np.random.Generator, generator: torch.Generator) -> float:
        """Take one step of descent on random points near the surface.

        Args:
            rays: points lie near what they meet, seen along them; lights are drawn from theirs.
            share: of the stage that is done, in [0, 1].
            rng: draws points and lights.
            generator: draws the jitter of the cells.

        Returns:
            The loss.
        """
        if self._count % _REFRESH == 0:
            self.field = self.snapshot()
        self._count += 1
        for group in self._optimiser.param_groups:
            group["lr"] = self._rates.at(share)
        points, lights, views = (torch.as_tensor(a, device=self.query.device) for a in self._points(rays, rng))
        loss = self.loss(points, lights, views, generator)
        self._optimiser.zero_grad(set_to_none=True)
        loss.backward()
        assert self.query.rows.grad is not None
        self.query.rows.grad[0] = 0  # empty space is shared by all corners outside the shell and stays empty
        self._optimiser.step()
        return float(loss.detach())

    def loss(
        self,
        x: Float[Tensor, "S 3"],
        light: Float[Tensor, "S 3"],
        view: Float[Tensor, "S 3"],
        generator: torch.Generator,
    ) -> Float[Tensor, ""]:
        """Return the squared error of a voxel's opacity, and of both parts of rho where the teacher is opaque.

        Args:
            x: points in the object's frame [m].
            light: unit vectors toward the light, in the object's frame.
            view: unit vectors from the camera into the scene, in the object's frame.
            generator: draws the jitter of the cells.
        """
        voxel = self.field.voxel
        with torch.no_grad():
            right = self.osf(x, light, view)
            alpha = alphas_from_thickness(right.sigma * voxel)
        mine = self.query(x, light, view, cell_jitter=_CELL_JITTER, generator=generator)
        error = ((mine.ambient - right.ambient) ** 2 + (mine.direct - right.direct) ** 2).sum(dim=-1)
        return (alpha * error + (alphas_from_thickness(mine.sigma * voxel) - alpha) ** 2).mean()

    def _points(self, rays: RayBatch, rng: np.random.Generator) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Draw random points near the surface, lights and views."""
        field, origins, directions = self.field, rays.origins[:_RAYS], rays.directions[:_RAYS]
        offsets = rng.random(len(origins), dtype=np.float32)
        ts, used = march(field, origins, directions, step=STEP_VOXELS * field.voxel, offsets=offsets)
        ray, slot = np.nonzero(used)
        chosen = rng.permutation(len(ray))[:_POINTS]
        ray, slot = ray[chosen], slot[chosen]
        points = origins[ray] + ts[ray, slot, None] * directions[ray]
        points += rng.uniform(-1, 1, points.shape).astype(np.float32) * np.float32(_SPREAD_VOXELS * field.voxel)
        lights = rng.choice(rays.lights, len(ray)) + rng.normal(0, _LIGHT_TURN, points.shape).astype(np.float32)
        return points, lights / np.linalg.norm(lights, axis=1, keepdims=True), directions[ray]

    def state(self) -> dict[str, Any]:
        """Return what a checkpoint needs besides the field."""
        return {**super().state(), "teacher": self.osf.state_dict(), "box": torch.tensor(self.osf.box)}

    @staticmethod
    def restored(field: KiloOSF, state: dict[str, Any], size: OSFSize, device: torch.device) -> Distillation:
        """Go on from a checkpoint.

        Args:
            field: as it was.
            state: as `state` returned it.
            size: of the teacher's network.
            device: that computes.
        """
        osf = OSF(state["box"].numpy(), size, device=device)
        osf.load_state_dict(state["teacher"])
        stage = Distillation(field, osf, device)
        stage.restore(state)
        return stage


# The whole training: its settings, its recipe, and its run.


_COARSE_RATES, _FINE_RATES = Rates(2e-2, 1e-2), Rates(2e-2, 1e-3)


@dataclass(frozen=True, slots=True)
class Recipe:
    """How a field is trained; docs/fields.md has the measurements behind the numbers.

    Attributes:
        coarse_across: voxels along the longest side in the first phase.
        fine_across: the same in the second.
        coarse_share: of the time budget.
        cells: tiny networks along the longest side.
        hidden: their width.
        rays: pixels per step of descent.
        solid_g: density feature inside the visual hull at first.
        hollow_across: instead of coarse_across for hollow objects: views agree on fine surfaces.
        hollow_g: density feature of the fog around the surfaces on which views agree, from which edges grow.
        hollow_steps: of descent without networks, before the first phase of a hollow object.
        hollow_share: instead of coarse_share for hollow objects: opening a hollow takes time.
        coarse_rates: learning rates of the first phase.
        fine_rates: of the second.
        teacher_share: of the time budget, in recipe "distil".
        distil_share: likewise.
    """

    coarse_across: int = 48
    fine_across: int = 96
    coarse_share: float = 0.15
    cells: int = 8
    hidden: int = 16
    rays: int = 4096
    solid_g: float = 6.0
    hollow_across: int = 96
    hollow_g: float = -5.5
    hollow_steps: int = 400
    hollow_share: float = 0.3
    coarse_rates: Rates = _COARSE_RATES
    fine_rates: Rates = _FINE_RATES
    teacher_share: float = 0.45
    distil_share: float = 0.1


@dataclass(frozen=True, slots=True)
class Pace:
    """How often a training reports; it does not change what is learned.

    Attributes:
        report_s: between two reports [s].
        checkpoint_s: between two checkpoints [s].
        clock: the time that counts for both and for the budget [s].
    """

    report_s: float = 1.0
    checkpoint_s: float = 20.0
    clock: Callable[[], float] = time.monotonic


@dataclass(frozen=True, slots=True)
class TrainField:
    """A training run.

    Attributes:
        data: image set in the OSF format; `train` is learned from, `test` measured on.
        out: file to write, FILE.safetensors; metrics go beside it to FILE.json.
        minutes: time budget of the descent [min].
        device: "auto", "cpu" or "cuda".
        seed: of everything random.
        iterations: instead of the time budget, that many steps: repeatable on one machine.
        hollow: the object has hollows that no silhouette shows, such as a bowl's; "direct" only.
        recipe: "direct", or "distil" for the paper's way over a teacher.
        teacher_width: units of each layer of the teacher.
        teacher_depth: its layers.
        lit: False for colours that do not depend on the light, as a NeRF's, to compare with; "direct" only.
    """

    data: Path
    out: Path
    minutes: float = 30.0
    device: Literal["auto", "cpu", "cuda"] = "auto"
    seed: int = 0
    iterations: int | None = None
    hollow: bool = False
    recipe: Literal["direct", "distil"] = "direct"
    teacher_width: int = 64
    teacher_depth: int = 4
    lit: bool = True


_AIMED_BYTES = 2_000_000
_NEEDED_WEIGHTS = (0.02, 0.05, 0.1, 0.2)  # of samples that a view must show, tried until the file is small enough
_OWN_METRICS = ("psnr_full", "psnr_mask")  # by which a file of metrics is known
_LOOK_SHARE = 0.05  # of the budget between two looks at held-out images
_MIN_LOOK_S = 5.0
_PHASES = {"direct": ("coarse", "fine"), "distil": ("teacher", "distil", "fine")}  # of the recipes
_TRANSITIONS = {"distil": "Baking the teacher into a shell", "fine": "Refining the shell"}
_Learner = Stage | NetworkStage  # a phase between its steps


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
    yield FieldStep(Progress(0, _total(config), "Reading the images"), None, None, None)
    train, test = read_splits(config.data)
    if train.is_opaque:
        expected = "an object before a transparent background is expected (opaque sets show the bare table)"
        raise CorruptFile(config.data, f"its images are opaque all over; {expected}")
    if not config.lit:  # l = 0 leaves n . l and the networks' weights for l without a gradient
        train, test = (replace(part, light_directions=np.zeros_like(part.light_directions)) for part in (train, test))
    yield from _Run(config, recipe or Recipe(), pace or Pace(), device, train, test).steps()


def _check(config: TrainField) -> None:
    check_budget(config.minutes, config.iterations)
    if config.recipe not in _PHASES:
        raise InvalidInput("recipe", config.recipe, "direct or distil")
    if config.recipe == "distil" and not config.lit:
        raise InvalidInput("recipe of a field without light", config.recipe, "direct")
    OSFSize(config.teacher_depth, config.teacher_width)  # refuses what cannot be built
    check_seed(config.seed)
    check_weights_place(config.out, _OWN_METRICS)


def _total(config: TrainField) -> int:
    return config.iterations or max(1, round(config.minutes * 60))


class _Run:
    """The state of one training run between its steps."""

    def __init__(
        self, config: TrainField, recipe: Recipe, pace: Pace, device: torch.device, train: ImageSet, test: ImageSet
    ) -> None:
        self._config, self._recipe, self._pace, self._device = config, recipe, pace, device
        self._teacher = TeacherRecipe(OSFSize(config.teacher_depth, config.teacher_width))
        self._images, self._source, self._test = train, RaySource(train), test
        self._pixels = self._source.silhouette_pixels()
        self._rng = np.random.default_rng(config.seed)
        self._generator = torch.Generator(device).manual_seed(config.seed)
        self._clock: dict[str, Any] = {"seconds": 0.0, "steps": 0, "looked_at": 0.0, "psnr": None}
        self._checkpoint_path = config.out.with_suffix(".partial")
        settings = {**asdict(config), "data": str(config.data.resolve()), "out": str(config.out)}
        digests = [train.digest(), test.digest()]
        self._fingerprint = {"settings": settings, "recipe": asdict(recipe), "images": digests}

    def steps(self) -> Iterator[FieldStep]:
        saved = Checkpoint.read(self._checkpoint_path, self._fingerprint)
        names, ends = _PHASES[self._config.recipe], self._ends()
        if saved is not None:
            with going_on_from(self._checkpoint_path):
                name, learner = saved.stage, self._resumed(saved)
            yield self._report("Going on from a checkpoint")
        else:
            yield self._report("Carving the silhouettes")
            name, learner = names[0], self._first()
        for number in range(names.index(name), len(names)):
            if number > names.index(name):
                yield self._report(_TRANSITIONS[names[number]])
                learner = self._next(names[number], learner)
                self._save(names[number], learner)
            yield from self._descend(names[number], learner, ends[number - 1] if number else 0.0, ends[number])
        yield self._report("Measuring on all held-out images")
        yield self._finish(learner.snapshot())

    def _ends(self) -> tuple[float, ...]:
        """Return the share of the budget at which each phase ends."""
        r = self._recipe
        if self._config.recipe == "direct":
            return r.hollow_share if self._config.hollow else r.coarse_share, 1.0
        return r.teacher_share, r.teacher_share + r.distil_share, 1.0

    def _first(self) -> _Learner:
        box = silhouette_box(self._images, where=self._config.data)
        r = self._recipe
        if self._config.recipe == "distil":
            return first_teacher(self._images, box, self._teacher, self._rng, self._device)
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
        """Return the learner of a phase, from that of the phase before."""
        r, field = self._recipe, before.snapshot()
        if isinstance(before, NetworkStage):
            assert isinstance(before.network, OSF)
            student = first_student(before.network, field, self._images, across=r.fine_across, cells=r.cells,
                                    hidden=r.hidden, rng=self._rng)  # fmt: skip
            return Distillation(student, before.network, self._device)
        if not isinstance(before, Distillation):
            field = refine(field, self._images, across=r.fine_across, rng=self._rng)
        return self._stage(name, field)

    def _share(self) -> float:
        """Return the share of the whole budget that is used up."""
        if self._config.iterations is not None:
            return min(1.0, self._clock["steps"] / self._config.iterations)
        return min(1.0, self._clock["seconds"] / (60 * self._config.minutes))

    def _descend(self, name: str, learner: _Learner, start: float, end: float) -> Iterator[FieldStep]:
        clock, already = self._pace.clock, self._clock["seconds"]
        count = self._teacher.rays if isinstance(learner, NetworkStage) else self._recipe.rays
        began = reported = saved = clock()
        while (share := self._share()) < end:
            rays = self._source.batch(self._rng.choice(self._pixels, count))
            learner.step(rays, (share - start) / (end - start), self._rng, self._generator)
            now = clock()
            self._clock |= {"steps": self._clock["steps"] + 1, "seconds": already + now - began}
            if now - reported > self._pace.report_s:
                reported = now
                yield self._look(learner)
            if now - saved > self._pace.checkpoint_s:
                saved = now
                self._save(name, learner)
            began += clock() - now  # looking and saving cost nobody's budget

    def _look(self, learner: _Learner) -> FieldStep:
        preview, seconds = None, self._clock["seconds"]
        if seconds - self._clock["looked_at"] > max(_MIN_LOOK_S, _LOOK_SHARE * 60 * self._config.minutes):
            network = learner.network if isinstance(learner, NetworkStage) else None
            look = Holdout(self._test, network).glance(learner.snapshot())
            self._clock |= {"looked_at": seconds, "psnr": (look.psnr_full, look.psnr_mask)}
            preview = look.preview
        share, psnr = self._share(), self._clock["psnr"]
        minutes, rest = divmod(round(seconds * (1 / share - 1) if share else 0.0), 60)
        quality = f"{psnr[0]:.1f} dB held out ({psnr[1]:.1f} in the mask), " if psnr else ""
        left = f"{minutes} min {rest} s" if minutes else f"{rest} s"
        return replace(self._report(f"{quality}{left} left"), preview=preview)

    def _report(self, words: str) -> FieldStep:
        total = _total(self._config)
        full, mask = self._clock["psnr"] or (None, None)
        return FieldStep(Progress(round(self._share() * total), total, words), full, mask, None)

    def _finish(self, field: KiloOSF) -> FieldStep:
        """Measure what users will read from the file, and write it once it is known to be sound."""
        config, data = self._config, self._trimmed(field)
        look = Holdout(self._test).everything(field_from_bytes(data, "The trained field"))
        metrics = {
            "psnr_full": round(look.psnr_full, 3),
            "psnr_mask": round(look.psnr_mask, 3),
            "test_images": look.images,
            "bytes": len(data),
            "minutes": round(self._clock["seconds"] / 60, 3),
            "iterations": self._clock["steps"],
            "seed": config.seed,
            "device": str(self._device),
            "threads": torch.get_num_threads(),
            "data": config.data.name,
            "train_images": len(self._images.cameras),
            "image_size": list(self._source.image_shape),
            "hollow": config.hollow,
            "lit": config.lit,
            "recipe": {"name": config.recipe, **asdict(self._recipe)},
        }
        if config.recipe == "distil":
            metrics["teacher"] = asdict(self._teacher)
        write_atomically(config.out, data)
        write_json(config.out.with_suffix(".json"), metrics)
        self._checkpoint_path.unlink(missing_ok=True)
        words = f"{look.psnr_full:.2f} dB held out, {look.psnr_mask:.2f} dB in the mask, {len(data) / 1e6:.2f} MB"
        total = _total(config)
        return FieldStep(Progress(total, total, words), look.psnr_full, look.psnr_mask, look.preview)

    def _trimmed(self, field: KiloOSF) -> bytes:
        """Return the field as a file of at most the size aimed at, if leaving out what hardly shows can make it so."""
        data = b""
        field = field if self._config.lit else without_light(field)
        for needed_weight in _NEEDED_WEIGHTS:
            data = field_bytes(trim(field, self._images, needed_weight))
            if len(data) <= _AIMED_BYTES:
                break
        return data

    def _save(self, name: str, learner: _Learner) -> None:
        random = {"numpy": self._rng.bit_generator.state, "torch": self._generator.get_state()}
        checkpoint = Checkpoint(name, learner.snapshot(), learner.state(), dict(self._clock), random)
        checkpoint.write(self._checkpoint_path, self._fingerprint)

    def _resumed(self, saved: Checkpoint) -> _Learner:
        if saved.stage == "teacher":
            learner = restored_teacher(saved.field, saved.optimiser, self._teacher, self._device)
        elif saved.stage == "distil":
            learner = Distillation.restored(saved.field, saved.optimiser, self._teacher.size, self._device)
        else:
            learner = self._stage(saved.stage, saved.field)
            learner.restore(saved.optimiser)
        self._clock = {name: saved.clock[name] for name in self._clock}
        self._rng.bit_generator.state = saved.random["numpy"]
        self._generator.set_state(saved.random["torch"])
        return learner
