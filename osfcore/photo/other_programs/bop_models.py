"""models_info.json of BOP: where the origin of each model lies.

Objects here have their origin at the centre of their bounding box. A model of BOP spans min_x to min_x + size_x, and so
on [mm], so that the centre lies at min + size / 2 in its frame. In BOP's own YCB-V that is zero.
"""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path

import numpy as np
from jaxtyping import Float
from pydantic import Field, FiniteFloat

from osfcore.io.files import read_json
from osfcore.io.json_codec import Entry, decode
from osfcore.photo.other_programs.ycb_video import NAMES, name_of

MODELS_INFO = "models_info.json"


class _ModelJson(Entry):
    min_x: FiniteFloat
    min_y: FiniteFloat
    min_z: FiniteFloat
    size_x: FiniteFloat = Field(gt=0)
    size_y: FiniteFloat = Field(gt=0)
    size_z: FiniteFloat = Field(gt=0)


def read_centres(models: Path | None) -> Mapping[str, Float[np.ndarray, "3"]]:
    """Box's centre in the model's frame, by name of the object [m].

    Args:
        models: folder with models_info.json; None for BOP's YCB-V, whose models are centred.

    Raises:
        CorruptFile: if there is none, or it is none.
    """
    if models is None:
        return dict.fromkeys(NAMES, np.zeros(3))
    entries = read_json(models / MODELS_INFO, lambda data: decode(dict[str, _ModelJson], data, MODELS_INFO))
    known = {str(number): name_of(number) for number in range(1, len(NAMES) + 1)}
    return {
        known[number]: 1e-3 * np.array([e.min_x + e.size_x / 2, e.min_y + e.size_y / 2, e.min_z + e.size_z / 2])
        for number, e in entries.items()
        if number in known
    }
