"""Fields and tables with factors on albedo and ambient light: what an image model makes of those of the library."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import replace

import numpy as np
from jaxtyping import Float

from osfcore.estimation.objective.object_models import ObjectModels
from osfcore.estimation.photometry.image_model import ImageModel
from osfcore.fields.kiloosf import KiloOSF
from osfcore.fields.table_field import TableField

_ALBEDO = slice(1, 4)  # among a field's features


def adapted(models: ObjectModels, names: Iterable[str], model: ImageModel) -> ObjectModels:
    """Models of some objects that show what `ImageModel.normalized` pictures do.

    Args:
        models: not adapted yet.
        names: of the objects.
        model: of the pictures.
    """
    return models.changed(
        names, lambda field: scaled_field(field, model.scale, model.ambient), lambda table: _adapted_table(table, model)
    )


def _adapted_table(table: TableField, model: ImageModel) -> TableField:
    scaled = scaled_table(table, model.scale * model.table, model.ambient)
    if model.surroundings is None:
        return scaled
    return replace(scaled, background=(model.surroundings * model.scale / model.gain).astype(np.float32))


def scaled_field(field: KiloOSF, albedo: float, ambient: float) -> KiloOSF:
    """A field with factors on its albedo and on its ambient light."""
    rows = field.rows.copy()
    rows[:, _ALBEDO] *= np.float32(albedo)
    return replace(field, rows=rows, ambient=field.ambient * np.float32(ambient))


def scaled_table(table: TableField, albedo: Float[np.ndarray, "3"], ambient: float) -> TableField:
    """A table with factors on its albedo, per colour, and on its ambient light."""
    factors = np.asarray(albedo, np.float32)
    return replace(table, albedo=table.albedo * factors, ambient=table.ambient * np.float32(ambient))
