"""From an OSF to a KiloOSF: the second of the paper's three steps; fine-tuning on images (optimise.py) follows.

The teacher's density is baked into the corners of a fine grid, which gives the shell; then albedo, dipoles, ambient
light and the tiny networks learn to answer as the teacher does at random points near the surface. Lights and views are
drawn from those that the images have, each light turned a little: elsewhere a teacher knows nothing (the published
recipe asks it at lights that it never saw). Points lie along pixels' rays, so that no view comes from inside.
"""

from __future__ import annotations

from typing import Any

import numpy as np
import torch
from jaxtyping import Float, Float32
from scipy import ndimage
from torch import Tensor

from osfcore.fields.kiloosf import EMPTY_G, FEATURES, FLOOR_G, STEP_VOXELS, KiloOSF
from osfcore.fields.osf import OSF, OSFSize
from osfcore.fields.ray_marching import march
from osfcore.fields.ray_sampling import RayBatch
from osfcore.fields.training.network_stage import baked_g, corners
from osfcore.fields.training.optimization import Rates, Stage
from osfcore.fields.voxel_shell import FIRST_NORMAL, first_shell, seen_corners, shell_field
from osfcore.io.image_set import ImageSet

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
