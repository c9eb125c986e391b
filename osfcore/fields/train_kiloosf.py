"""Training a KiloOSF straight from images, cameras, lights and silhouettes: a coarse solid first, then a fine shell.

Phases share the time budget. There are two recipes:

- "direct": the visual hull of the silhouettes becomes a coarse field. It learns until it has found the surfaces,
  including those that no silhouette shows. The corners that some pixel sees are then kept on a fine grid, which learns
  the rest.
- "distil", as in the paper: an OSF learns from the images; a fine field learns from the OSF, and then from the images.

A checkpoint beside the output lets the same command continue after it was killed.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import asdict, dataclass, replace
from typing import Any, Literal

import numpy as np
import torch
from jaxtyping import Float, Float32
from scipy import ndimage
from torch import Tensor

from osfcore.errors import InvalidInput
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
from osfcore.fields.rays import FIRST_NORMAL, RayBatch, first_shell, march, refine, reshelled, seen_corners, trim
from osfcore.fields.train_osf import (
    Checkpoint,
    FieldSettings,
    FieldStep,
    FieldTraining,
    Holdout,
    Learner,
    Look,
    NetworkStage,
    Pace,
    Rates,
    Stage,
    TeacherRecipe,
    baked_g,
    corners,
    first_teacher,
    restored_teacher,
)
from osfcore.fields.visual_hull import silhouette_box
from osfcore.fields.volume_rendering import alphas_from_thickness
from osfcore.io.image_set import ImageSet
from osfcore.progress import Progress

# From an OSF to a KiloOSF: the second of the paper's three steps; fine-tuning on images follows.
#
# The teacher's density is baked into the corners of a fine grid, which gives the shell. Albedo, dipoles, ambient light
# and the tiny networks then learn the teacher's values at random points near the surface. Lights and views are drawn
# from those of the images, with each light turned a little, because a teacher is wrong elsewhere. (The published recipe
# uses lights that the teacher never saw.) Points lie along pixels' rays, so that no view comes from inside.


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
    """Return a field with the teacher's density and albedo, and dipoles across its surface.

    Args:
        osf: the teacher.
        proposal: its density on a coarse grid.
        images: images whose views decide which corners matter.
        across: voxels along the longest side.
        cells: tiny networks along the longest side.
        hidden: width of the tiny networks.
        rng: random generator of the networks' initial weights.
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
    """Return the box of the teacher's density on the proposals' grid, with a margin of one voxel [m]."""
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
        """Start with a field's numbers and a trained teacher."""
        super().__init__(field, _DISTILLATION_RATES, device)
        self.osf = osf

    def step(self, rays: RayBatch, share: float, rng: np.random.Generator, generator: torch.Generator) -> float:
        """Take one step of descent on random points near the surface.

        Args:
            rays: rays along which points lie near the surface, and whose lights are drawn.
            share: share of the stage that is done, in [0, 1].
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
        """Return the contents of a checkpoint besides the field."""
        return {**super().state(), "teacher": self.osf.state_dict(), "box": torch.tensor(self.osf.box)}

    @staticmethod
    def restored(field: KiloOSF, state: dict[str, Any], size: OSFSize, device: torch.device) -> Distillation:
        """Continue from a checkpoint.

        Args:
            field: the field in the checkpoint.
            state: the result of `state`.
            size: size of the teacher's network.
            device: PyTorch device.
        """
        osf = OSF(state["box"].numpy(), size, device=device)
        osf.load_state_dict(state["teacher"])
        stage = Distillation(field, osf, device)
        stage.restore(state)
        return stage


# The whole training: its settings, its recipe, and its run.


_CARVING, _REFINING = "Carving the silhouettes", "Refining the shell"  # reported before phases begin
_COARSE_RATES, _FINE_RATES = Rates(2e-2, 1e-2), Rates(2e-2, 1e-3)


@dataclass(frozen=True, slots=True)
class Recipe:
    """Settings of a training; docs/notes/fields.md has the measurements behind the numbers.

    Attributes:
        coarse_across: voxels along the longest side in the first phase.
        fine_across: voxels along the longest side in the second phase.
        coarse_share: share of the time budget for the first phase.
        cells: tiny networks along the longest side.
        hidden: width of the tiny networks.
        rays: pixels per step of descent.
        solid_g: initial density feature inside the visual hull.
        hollow_across: replaces coarse_across for hollow objects, since views agree only on fine surfaces.
        hollow_g: density feature of the fog around the surfaces on which views agree, from which edges can grow.
        hollow_steps: steps of descent without networks, before the first phase of a hollow object.
        hollow_share: replaces coarse_share for hollow objects, since opening a hollow takes time.
        coarse_rates: learning rates of the first phase.
        fine_rates: learning rates of the second.
        teacher_share: share of the time budget for the teacher, in recipe "distil".
        distil_share: share of the time budget for distillation, in recipe "distil".
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
class TrainField(FieldSettings):
    """A training run.

    Attributes:
        hollow: whether the object has hollows that no silhouette shows, such as a bowl; only with recipe "direct".
        recipe: "direct", or "distil" to learn from a teacher as in the paper.
        lit: False for colours that do not depend on the light, as in a NeRF, for comparison; only with recipe "direct".
    """

    hollow: bool = False
    recipe: Literal["direct", "distil"] = "direct"
    lit: bool = True

    def check(self) -> None:
        """Check the ranges and the output.

        Raises:
            InvalidInput: if a value is out of range, or another program's file lies in place of the metrics.
            CannotWrite: if the output cannot be written.
        """
        if self.recipe not in ("direct", "distil"):
            raise InvalidInput("recipe", self.recipe, "direct or distil")
        if self.recipe == "distil" and not self.lit:
            raise InvalidInput("recipe of a field without light", self.recipe, "direct")
        FieldSettings.check(self)


_AIMED_BYTES = 2_000_000
_NEEDED_WEIGHTS = (0.02, 0.05, 0.1, 0.2)  # of samples that a view must show, tried until the file is small enough


def train_field(config: TrainField, recipe: Recipe | None = None, pace: Pace | None = None) -> Iterator[FieldStep]:
    """Train a field from an image set and write it.

    Raises:
        InvalidInput: if the settings are out of range, there is no GPU for "cuda", or another program's file lies in
            place of the metrics.
        CorruptFile: if the image set is damaged, nothing of the object could be learned, or the checkpoint of a killed
            run cannot be used.
        CannotWrite: if the output cannot be written, which is checked first.
    """
    device = pick_device(config.device)
    config.check()
    yield FieldStep(Progress(0, config.total, "Reading the images"))
    train, test = config.images()
    if not config.lit:  # l = 0 leaves n . l and the networks' weights for l without a gradient
        train, test = (replace(part, light_directions=np.zeros_like(part.light_directions)) for part in (train, test))
    yield from _Training(config, recipe or Recipe(), pace or Pace(), device, train, test).steps()


class _Training(FieldTraining):
    def __init__(
        self, config: TrainField, recipe: Recipe, pace: Pace, device: torch.device, train: ImageSet, test: ImageSet
    ) -> None:
        super().__init__(config, asdict(recipe), pace, device, train, test)
        self._config, self._recipe = config, recipe
        self._teacher = TeacherRecipe(OSFSize(config.teacher_depth, config.teacher_width))
        if config.recipe == "direct":
            coarse_share = recipe.hollow_share if config.hollow else recipe.coarse_share
            self.phases = {"coarse": (coarse_share, _CARVING), "fine": (1.0, _REFINING)}
        else:
            self.phases = {
                "teacher": (recipe.teacher_share, _CARVING),
                "distil": (recipe.teacher_share + recipe.distil_share, "Baking the teacher into a shell"),
                "fine": (1.0, _REFINING),
            }

    def rays(self, phase: str) -> int:
        return self._teacher.rays if phase == "teacher" else self._recipe.rays

    def begun(self, phase: str, before: Learner | None) -> Learner:
        r = self._recipe
        if before is None:
            box = silhouette_box(self.train, where=self._config.data)
            if phase == "teacher":
                return first_teacher(self.train, box, self._teacher, self.rng, self.device)
            return self._stage(phase, self._coarse(box))
        field = before.snapshot()
        if isinstance(before, NetworkStage):
            assert isinstance(before.network, OSF)
            student = first_student(before.network, field, self.train, across=r.fine_across, cells=r.cells,
                                    hidden=r.hidden, rng=self.rng)  # fmt: skip
            return Distillation(student, before.network, self.device)
        if not isinstance(before, Distillation):
            field = refine(field, self.train, across=r.fine_across, rng=self.rng)
        return self._stage(phase, field)

    def _coarse(self, box: Float[np.ndarray, "2 3"]) -> KiloOSF:
        """Fill the visual hull, or the surfaces of a hollow object on which the views agree."""
        r, hollow = self._recipe, self._config.hollow
        across = r.hollow_across if hollow else r.coarse_across
        field = first_shell(self.train, box, across=across, cells=r.cells, hidden=r.hidden,
                            inside_g=r.solid_g, rng=self.rng)  # fmt: skip
        if hollow:
            field = open_hollows(field, self.train, fog_g=r.hollow_g)
            field = without_fog(fit_voxels(field, self.train, steps=r.hollow_steps, rays=r.rays, rng=self.rng))
        return field

    def _stage(self, phase: str, field: KiloOSF) -> Stage:
        r = self._recipe
        return Stage(field, r.coarse_rates if phase == "coarse" else r.fine_rates, self.device)

    def resumed(self, saved: Checkpoint) -> Learner:
        if saved.stage == "teacher":
            return restored_teacher(saved.field, saved.optimiser, self._teacher, self.device)
        if saved.stage == "distil":
            return Distillation.restored(saved.field, saved.optimiser, self._teacher.size, self.device)
        stage = self._stage(saved.stage, saved.field)
        stage.restore(saved.optimiser)
        return stage

    def finished(self, learner: Learner) -> tuple[bytes, Look, dict[str, Any]]:
        config, data = self._config, self._trimmed(learner.snapshot())
        look = Holdout(self.test).everything(field_from_bytes(data, "The trained field"))
        recipe = {"name": config.recipe, **asdict(self._recipe)}
        teacher = {"teacher": asdict(self._teacher)} if config.recipe == "distil" else {}
        return data, look, {"hollow": config.hollow, "lit": config.lit, "recipe": recipe, **teacher}

    def _trimmed(self, field: KiloOSF) -> bytes:
        """Return the field as a file of at most the wanted size, if removing hardly visible parts is enough."""
        data = b""
        field = field if self._config.lit else without_light(field)
        for needed_weight in _NEEDED_WEIGHTS:
            data = field_bytes(trim(field, self.train, needed_weight))
            if len(data) <= _AIMED_BYTES:
                break
        return data
