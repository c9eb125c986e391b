"""Compositional neural radiance fields (Driess et al., 2022) in our loop: what relightable fields are worth.

Each object has a field of ours whose radiance does not depend on the light (`osf train field --method nerf`): the same
network, images, budget and renderer, without l in paper eq. 1. Trained on images under many lights, it learns how an
object looks on average. Nothing casts a shadow, and the table is as bright as on average over the lights above it.

Deviations from the published model: fields are composed by the object poses that our loop estimates, instead of by
latent vectors that an encoder makes of images and masks, and pushes are predicted by our dynamics instead of a network
over these vectors; each field learns from images of its object alone, 385 under as many lights, instead of from scenes
of 1,000 trajectories. What differs from our method: fields, table, no shadows, and no light is estimated; the pusher is
drawn as ours. A latent vector can hold how brightly an object is lit; here that may be fitted to the true image
(`with_fitted_brightness`).
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import replace
from importlib.resources import files
from pathlib import Path

import numpy as np
from jaxtyping import Bool, Float
from scipy.optimize import nnls

from osfcore.control.estimators import SceneModels
from osfcore.estimation.objective import ObjectModels
from osfcore.experiments.rivals import repository_weights
from osfcore.fields.field_library import FieldLibrary
from osfcore.fields.kiloosf import KiloOSF
from osfcore.fields.table import TableField
from osfcore.geometry.cameras import Camera
from osfcore.geometry.poses import fibonacci_sphere
from osfcore.render.renderer import SceneRenderer
from osfcore.render.types import EXACT, Quality, Rendered, SceneBatch

_FOLDER = "nerf"
_NO_SHADOWS = 1e9  # voxels between samples of shadow rays: the first one already lies behind everything
_LIGHTS = 4096


class UnlitRenderer(SceneRenderer):
    """Fields that know of no light: nothing casts a shadow."""

    def __init__(self, fields: Mapping[str, KiloOSF], table: TableField | None) -> None:
        """Prepare fields.

        Args:
            fields: trained without light, by name.
            table: ours, of which the mean over all lights is shown; None for black surroundings.
        """
        super().__init__(fields, None if table is None else mean_table(table))

    def render(
        self,
        batch: SceneBatch,
        cameras: Sequence[Camera],
        *,
        quality: Quality = EXACT,
        outputs: frozenset[str] | set[str] = frozenset({"rgb"}),
        only: Bool[np.ndarray, "V h w"] | None = None,
    ) -> Rendered:
        """Render every scene of a batch from every camera; its lights play no part."""
        unlit = replace(quality, shadow_voxels=_NO_SHADOWS)
        return super().render(replace(batch, spots=None), cameras, quality=unlit, outputs=outputs, only=only)


def mean_table(table: TableField) -> TableField:
    """Return a table that is as bright under every light as it is on average over the hemisphere.

    Least squares would find it for a table without light, from images under lights that are uniform over the sky.
    """
    lights = fibonacci_sphere(2 * _LIGHTS)[:_LIGHTS]  # its upper half
    ambient = (table.ambient + table.direct(lights).mean(axis=0)).astype(np.float32)
    return replace(table, ambient=ambient, w2=np.zeros_like(table.w2), b2=np.zeros_like(table.b2))


def with_fitted_brightness(
    shown: Float[np.ndarray, "V h w 3"], opacity: Float[np.ndarray, "V N h w"], truth: Float[np.ndarray, "V h w 3"]
) -> Float[np.ndarray, "V h w 3"]:
    """Scale each object and the table by a factor of its own, so that images come as close to the truth as they can.

        min_g |I_true - I (sum_n o_n g_n + (1 - sum_n o_n) g_table)|^2,    g >= 0

    This is what an encoder of images could tell of a scene's brightness at best, for it is read off the truth.

    Args:
        shown: images (I).
        opacity: how much of each pixel shows each object (o).
        truth: what they should look like.
    """
    shares = np.concatenate([opacity, 1 - opacity.sum(axis=1, keepdims=True)], axis=1)
    parts = np.moveaxis(shown[:, None] * shares[..., None], 1, -1)  # (V, h, w, 3, N + 1)
    columns = parts.reshape(-1, parts.shape[-1]).astype(float)
    gains, _ = nnls(columns.T @ columns, columns.T @ truth.reshape(-1))
    return np.clip(parts @ gains, 0, 1)


def nerf_library(data_dir: Path | None) -> FieldLibrary:
    """Return the fields without light: DATA_DIR/nerf/fields/NAME/field.safetensors, and those of the repository.

    Raises:
        OsfError: if neither are there.
    """
    own = None if data_dir is None else data_dir / _FOLDER
    if own is not None and (own / "fields").is_dir():
        return FieldLibrary(own, shipped=Path(str(files("osfcore.experiments.rivals") / "shipped" / "nerf")))
    return FieldLibrary(own, shipped=repository_weights("nerf", f"DATA_DIR/{_FOLDER}/fields"))


def load_nerf_appearance(names: Iterable[str], fields: FieldLibrary, data_dir: Path | None) -> ObjectModels:
    """Load objects and table that know of no light.

    Args:
        names: of the objects.
        fields: library of the table.
        data_dir: whose fields come before the installed ones.

    Raises:
        UnknownName: if an object has no such field.
        CorruptFile: if a file is broken.
    """
    library = nerf_library(data_dir)
    return ObjectModels.rendered_by(UnlitRenderer, {name: library.load(name) for name in names}, fields.load_table())


def with_nerfs(models: SceneModels, fields: FieldLibrary, data_dir: Path | None) -> SceneModels:
    """Replace the appearance of models by that of fields without light.

    Args:
        models: ours, of a scene's objects.
        fields: library of the table.
        data_dir: whose fields come before the installed ones.

    Raises:
        UnknownName: if an object has no such field.
        CorruptFile: if a file is broken.
    """
    return replace(models, appearance=load_nerf_appearance(tuple(models.shapes), fields, data_dir))
