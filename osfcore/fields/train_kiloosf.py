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

import numba
import numpy as np
import torch
from jaxtyping import Float, Float32, UInt8
from scipy import ndimage
from torch import Tensor

from osfcore.errors import CorruptFile, InvalidInput, check_seed
from osfcore.fields.devices import pick_device
from osfcore.fields.hollow import open_hollows, without_fog
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
    FIRST_AMBIENT,
    FIRST_NORMAL,
    ONE_AT_A_TIME,
    RayBatch,
    RaySource,
    clip_axis,
    first_shell,
    march,
    optical_density,
    refine,
    seen_corners,
    shell_field,
    trim,
    within,
)
from osfcore.fields.train_osf import (
    Checkpoint,
    Holdout,
    NetworkHoldout,
    NetworkStage,
    Rates,
    Stage,
    TeacherRecipe,
    baked_g,
    corners,
    first_teacher,
    read_checkpoint,
    restored_teacher,
    write_checkpoint,
)
from osfcore.fields.visual_hull import silhouette_box
from osfcore.io.checkpoint import going_on_from
from osfcore.io.files import write_atomically, write_json
from osfcore.io.image_set import ImageSet, read_splits
from osfcore.io.output_paths import check_weights_place
from osfcore.progress import Progress

# Descent on the voxels of a field alone, without networks: where nothing sees the view, no lid explains a hollow.
#
# Each corner has a density, an albedo and its own dependence on the light, of second order in l, which learns
# shadows:
#
#     radiance = albedo * (ambient + max(c . Y(l), 0))
#     Y(l) = (1, l, l_x l_y, l_y l_z, l_x l_z, l_x^2 - l_y^2, 3 l_z^2 - 1)
#
# Errors count relative to brightness, since the inside of a hollow is mostly in shadow. Compiled for the CPU.


_FEATURES = 13  # g, albedo (3), c (9)
_FIRST_GAIN = 0.2
_RATES = np.array([0.06] + [0.03] * 7 + [0.01] * 5, np.float32)  # of Adam, for each feature
_COLOUR_STEPS = 60  # at first, in which density waits
_MOST_G = 10.0
_DARK = np.float32(0.05)  # brightness below which errors count as they are
_ALPHA_WEIGHT = np.float32(0.5)
_MOST_SAMPLES = 256
_MOST_DEPTH = np.float32(6)  # optical depth at which a ray ends
_PARTS = 4  # of a batch, each with its own sum: the same result on any number of threads
_FLOOR_G, _AMBIENT = np.float32(FLOOR_G), np.float32(FIRST_AMBIENT)
_ZERO, _ONE = np.float32(0), np.float32(1)


def fit_voxels(field: KiloOSF, images: ImageSet, *, steps: int, rays: int, rng: np.random.Generator) -> KiloOSF:
    """The field with density, albedo and dipole as some steps of descent leave them.

    Args:
        field: where to begin; its albedo is not looked at, nor are its networks.
        images: what to learn from.
        steps: of Adam.
        rays: for each.
        rng: chooses pixels and the offsets of samples.
    """
    source = RaySource(images)
    pixels = source.silhouette_pixels()
    values = np.zeros((len(field.rows), _FEATURES), np.float32)
    values[:, 0], values[:, 1:4], values[:, 4] = field.rows[:, 0], 0.3, _FIRST_GAIN
    values[:, 5:8] = field.rows[:, 4:7] * (0.3 / FIRST_NORMAL)
    mean, square = np.zeros_like(values), np.zeros_like(values)
    for step in range(1, steps + 1):
        _keep_within(values)
        batch = source.batch(rng.choice(pixels, rays))
        gradient = _gradient(values, field, batch, rng.random(rays, dtype=np.float32))
        mean += 0.1 * (gradient - mean)
        square += 0.01 * (gradient * gradient - square)
        change = _RATES * (mean / (1 - 0.9**step)) / (np.sqrt(square / (1 - 0.99**step)) + 1e-12)
        values -= change if step > _COLOUR_STEPS else np.where(np.arange(_FEATURES) == 0, 0, change)
    _keep_within(values)
    rows = field.rows.copy()
    rows[1:, :4], rows[1:, 4:7] = values[1:, :4], values[1:, 5:8]
    return replace(field, rows=rows)


def _keep_within(values: Float32[np.ndarray, "M 13"]) -> None:
    """Clip to what features may be; row 0 is empty space."""
    np.clip(values[:, 0], -_MOST_G, _MOST_G, out=values[:, 0])
    np.clip(values[:, 1:4], 0, 1, out=values[:, 1:4])
    values[0] = 0
    values[0, 0] = EMPTY_G


def _gradient(
    values: Float32[np.ndarray, "M 13"], field: KiloOSF, rays: RayBatch, offsets: Float32[np.ndarray, "R"]
) -> Float32[np.ndarray, "M 13"]:
    """Of the loss, which is the mean over rays."""
    parts = np.zeros((_PARTS, *values.shape), np.float32)
    origins = (rays.origins - field.origin) / np.float32(field.voxel)
    arrays = (origins, rays.directions, rays.lights, rays.rgb, rays.alpha, offsets)
    with ONE_AT_A_TIME:
        _descend(parts, values, field.index, *(np.ascontiguousarray(a, np.float32) for a in arrays))
    return parts.sum(axis=0) / np.float32(len(offsets))


@numba.njit(fastmath=True, error_model="numpy")
def _harmonics(light, out):  # noqa: ANN001, ANN202
    """Y(l)."""
    x, y, z = light
    out[0], out[1], out[2], out[3], out[4], out[5], out[6] = _ONE, x, y, z, x * y, y * z, x * z
    out[7], out[8] = x * x - y * y, 3 * z * z - _ONE


@numba.njit(fastmath=True, error_model="numpy")
def _corners(index, p, rows, weights):  # noqa: ANN001, ANN202
    """Rows and weights of the eight corners around a point in voxel coordinates."""
    i, j, k = int(p[0]), int(p[1]), int(p[2])
    fx, fy, fz = p[0] - np.float32(i), p[1] - np.float32(j), p[2] - np.float32(k)
    for q in range(8):
        a, b, c = q >> 2, (q >> 1) & 1, q & 1
        rows[q] = index[i + a, j + b, k + c]
        weights[q] = (fx if a else _ONE - fx) * (fy if b else _ONE - fy) * (fz if c else _ONE - fz)


@numba.njit(fastmath=True, error_model="numpy")
def _walk(values, index, origin, direction, offset, rows, weights, features):  # noqa: ANN001, ANN202
    """Features along a ray, one sample a voxel, where there is density; returns how many samples there are."""
    start, end = _ZERO, np.float32(1e9)
    for axis in range(3):
        start, end = clip_axis(
            origin[axis], direction[axis], _ZERO, np.float32(index.shape[axis]) - np.float32(1.001), start, end
        )
    count, depth, t = 0, _ZERO, start + offset
    p = np.empty(3, np.float32)
    while t < end and count < _MOST_SAMPLES and depth < _MOST_DEPTH:
        for axis in range(3):
            p[axis] = within(origin[axis] + t * direction[axis], index.shape[axis])
        t += _ONE
        _corners(index, p, rows[count], weights[count])
        g = _ZERO
        for q in range(8):
            g += weights[count, q] * values[rows[count, q], 0]
        if g <= _FLOOR_G:
            continue
        for c in range(_FEATURES):
            total = _ZERO
            for q in range(8):
                total += weights[count, q] * values[rows[count, q], c]
            features[count, c] = total
        depth += optical_density(g)
        count += 1
    return count


@numba.njit(fastmath=True, error_model="numpy")
def _shade(features, count, light, gains, colour):  # noqa: ANN001, ANN202
    """Composite the samples of a ray: fills their gains and the ray's colour, and returns its optical depth."""
    colour[:] = 0
    depth = _ZERO
    for s in range(count):
        gain = _ZERO
        for c in range(9):
            gain += features[s, 4 + c] * light[c]
        gains[s] = gain
        own = optical_density(features[s, 0])
        weight = np.exp(-depth) * (_ONE - np.exp(-own)) * (_AMBIENT + max(gain, _ZERO))
        for c in range(3):
            colour[c] += weight * features[s, 1 + c]
        depth += own
    return depth


@numba.njit(fastmath=True, error_model="numpy")
def _spread(rows, weights, features, gains, count, depth, light, slope, slope_alpha, out):  # noqa: ANN001, ANN202
    """Add a ray's part to the gradient: back to front, with the light from behind summed up on the way."""
    behind, through = _ZERO, np.exp(-depth)
    own = np.empty(_FEATURES, np.float32)
    for s in range(count - 1, -1, -1):
        g = features[s, 0]
        after = np.exp(-depth)
        depth -= optical_density(g)
        weight = np.exp(-depth) - after
        shade = _AMBIENT + max(gains[s], _ZERO)
        toward = slope[0] * features[s, 1] + slope[1] * features[s, 2] + slope[2] * features[s, 3]
        own[0] = (after * toward * shade - behind + slope_alpha * through) / (_ONE + np.exp(-g))
        behind += weight * toward * shade
        for c in range(3):
            own[1 + c] = weight * slope[c] * shade
        for c in range(9):
            own[4 + c] = weight * toward * light[c] if gains[s] > 0 else _ZERO
        for q in range(8):
            for c in range(_FEATURES):
                out[rows[s, q], c] += weights[s, q] * own[c]


@numba.njit(parallel=True, fastmath=True, error_model="numpy", cache=True, nogil=True)
def _descend(parts, values, index, origins, directions, lights, rgb, alpha, offsets):  # noqa: ANN001, ANN202
    for part in numba.prange(len(parts)):
        rows, weights = np.empty((_MOST_SAMPLES, 8), np.int32), np.empty((_MOST_SAMPLES, 8), np.float32)
        features, gains = np.empty((_MOST_SAMPLES, _FEATURES), np.float32), np.empty(_MOST_SAMPLES, np.float32)
        light, colour, slope = np.empty(9, np.float32), np.empty(3, np.float32), np.empty(3, np.float32)
        for r in range(part, len(origins), len(parts)):
            count = _walk(values, index, origins[r], directions[r], offsets[r], rows, weights, features)
            _harmonics(lights[r], light)
            depth = _shade(features, count, light, gains, colour)
            level = (colour[0] + colour[1] + colour[2]) / np.float32(3) + _DARK
            for c in range(3):
                slope[c] = 2 * (colour[c] - rgb[r, c]) / (level * level)
            miss = 2 * _ALPHA_WEIGHT * (_ONE - np.exp(-depth) - alpha[r])
            _spread(rows, weights, features, gains, count, depth, light, slope, miss, parts[part])


# From an OSF to a KiloOSF: the second of the paper's three steps; fine-tuning on images follows.
#
# The teacher's density is baked into the corners of a fine grid, which gives the shell; then albedo, dipoles,
# ambient light and the tiny networks learn to answer as the teacher does at random points near the surface. Lights
# and views are drawn from those that the images have, each light turned a little: elsewhere a teacher knows nothing
# (the published recipe asks it at lights that it never saw). Points lie along pixels' rays, so that no view comes
# from inside.


RATES = Rates(2e-2, 5e-3)
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
    """A field with the teacher's density and albedo, and dipoles across its surface.

    Args:
        osf: teacher.
        proposal: its density on a coarse grid.
        images: whose views tell which corners matter.
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
    ambient = osf.ambient.detach().cpu().numpy().copy()

    def field(keep: np.ndarray) -> KiloOSF:
        return shell_field(whole.origin, whole.voxel, features, keep, whole.cells, whole.networks, ambient)

    seen = seen_corners(field(np.ones(whole.index.shape, bool)), images, rng)
    return field(ndimage.binary_dilation(seen, iterations=2))


def _occupied_box(osf: OSF, proposal: KiloOSF) -> Float[np.ndarray, "2 3"]:
    """Around all that the teacher's density reaches on the proposals' grid, a voxel wider on every side [m]."""
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

    def __init__(self, field: KiloOSF, osf: OSF, device: torch.device, rates: Rates = RATES) -> None:
        """Begin with a field's numbers and a trained teacher."""
        super().__init__(field, rates, device)
        self.osf = osf

    def step(self, rays: RayBatch, share: float, rng: np.random.Generator, generator: torch.Generator) -> float:
        """One step of descent on random points near the surface.

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
        points, lights, views = (torch.as_tensor(a, device=self.query.rows.device) for a in self._points(rays, rng))
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
        """Squared error of a voxel's opacity, and of both parts of rho where the teacher is opaque.

        Args:
            x: points in the object's frame [m].
            light: unit vectors toward the light, in the object's frame.
            view: unit vectors from the camera into the scene, in the object's frame.
            generator: draws the jitter of the cells.
        """
        voxel = self.field.voxel
        with torch.no_grad():
            right = self.osf(x, light, view)
            alpha = -torch.expm1(-right.sigma * voxel)
        mine = self.query(x, light, view, cell_jitter=_CELL_JITTER, generator=generator)
        error = ((mine.ambient - right.ambient) ** 2 + (mine.direct - right.direct) ** 2).sum(dim=-1)
        return (alpha * error + (-torch.expm1(-mine.sigma * voxel) - alpha) ** 2).mean()

    def _points(self, rays: RayBatch, rng: np.random.Generator) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Random points near the surface, lights and views."""
        field = self.field
        some = slice(0, _RAYS)
        origins, directions = rays.origins[some], rays.directions[some]
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
        """What a checkpoint needs besides the field."""
        box = torch.tensor(self.osf.box)
        return {**super().state(), "teacher": self.osf.state_dict(), "box": box}

    @staticmethod
    def restored(field: KiloOSF, state: dict[str, Any], size: OSFSize, device: torch.device) -> Distillation:
        """Go on from a checkpoint.

        Args:
            field: as it was.
            state: what `state` told.
            size: of the teacher's network.
            device: that computes.
        """
        osf = OSF(state["box"].numpy(), size, device=device)
        osf.load_state_dict(state["teacher"])
        stage = Distillation(field, osf, device)
        stage.restore(state)
        return stage


# What a training of a KiloOSF is told: its settings and its recipe.


_COARSE_RATES = Rates(2e-2, 1e-2)


_FINE_RATES = Rates(2e-2, 1e-3)


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
    """How often a training that runs is heard of; no matter to what it learns.

    Attributes:
        report_s: between two steps that are told [s].
        checkpoint_s: between two checkpoints [s].
        clock: tells the time that counts for both and for the budget [s].
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
