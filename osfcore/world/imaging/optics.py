"""The image model's materials and lamp: what every picture of this project is made of.

Lambert shading without specular part, as stated in the README's conventions:
radiance = albedo * (ambient + diffuse * max(0, n . l) * visible), visible in {0, 1}. Values are linear, no gamma.
A near lamp has its place, cone and falloff besides (`SpotLamp`).
Lamps of another strength or colour, and other tables, are for measuring what a method does that is not told of them.
"""

from __future__ import annotations

from dataclasses import dataclass, field

import cv2
import numpy as np
from jaxtyping import Float

from osfcore.errors import InvalidInput
from osfcore.geometry.light import AMBIENT, DIFFUSE
from osfcore.geometry.workspace import TABLE_SIDE_M

TABLE_ALBEDO = (0.66, 0.62, 0.56)  # pale wood, uniform, so that only light and shadow change it
BACKGROUND_RADIANCE = (0.10, 0.11, 0.12)  # beyond the table's edge; no lamp reaches it
WHITE = (1.0, 1.0, 1.0)
_REMAP_COLUMNS = 512  # OpenCV's remap takes at most 32767 rows and columns


@dataclass(frozen=True, slots=True)
class Lamp:
    """How strongly the scene is lit.

    Attributes:
        ambient: radiance of a white surface in shadow.
        diffuse: what the light adds when it falls in along the normal.
        intensity: factor on both.
        colour: factors on both, of red, green and blue.
    """

    ambient: float = AMBIENT
    diffuse: float = DIFFUSE
    intensity: float = 1.0
    colour: tuple[float, float, float] = WHITE


@dataclass(frozen=True, eq=False, slots=True)
class TableSurface:
    """What the table's top looks like.

    Attributes:
        albedo: of every point, linear; without a meaning where there is a texture.
        texture: linear albedo in [0, 1], spread once over the table: its first row lies at the side of greatest y, its
            first column at that of least x. None for a table of one colour.
        levels: the texture and its halvings down to one texel, each the area average of the one before.
    """

    albedo: tuple[float, float, float] = TABLE_ALBEDO
    texture: Float[np.ndarray, "rows columns 3"] | None = None
    levels: tuple[Float[np.ndarray, "_ _ 3"], ...] = field(init=False, repr=False)

    def __post_init__(self) -> None:
        """Check the texture and halve it.

        Raises:
            InvalidInput: if the texture is not linear RGB in [0, 1].
        """
        levels = []
        if self.texture is not None:
            texture = np.ascontiguousarray(self.texture, np.float32)
            if texture.ndim != 3 or texture.shape[2] != 3 or not np.all((texture >= 0) & (texture <= 1)):
                raise InvalidInput("texture of the table", f"of shape {texture.shape}", "rows of RGB in [0, 1]")
            levels.append(texture)
            while max(levels[-1].shape[:2]) > 1:
                half = tuple(max(side // 2, 1) for side in levels[-1].shape[1::-1])
                levels.append(cv2.resize(levels[-1], half, interpolation=cv2.INTER_AREA))
        object.__setattr__(self, "levels", tuple(levels))

    def albedo_at(self, points: Float[np.ndarray, "S 2"], footprint_m: float = 0.0) -> Float[np.ndarray, "S 3"]:
        """Albedo of points of the table, interpolated between texels.

        Args:
            points: x and y in the world [m].
            footprint_m: side of the square over which a texture is averaged [m]; 0 takes its finest level.
        """
        if self.texture is None:
            return np.broadcast_to(np.array(self.albedo, np.float32), (len(points), 3))
        level = float(np.log2(max(footprint_m * max(self.texture.shape[:2]) / TABLE_SIDE_M, 1.0)))
        level = min(level, len(self.levels) - 1.0)
        fine = int(level)
        albedo = _bilinear(self.levels[fine], points)
        if level > fine:
            albedo += (level - fine) * (_bilinear(self.levels[fine + 1], points) - albedo)
        return albedo


def _bilinear(texture: Float[np.ndarray, "rows columns 3"], points: Float[np.ndarray, "S 2"]) -> np.ndarray:
    """Texels at points of the table [m], clamped at its edge."""
    height, width = texture.shape[:2]
    count = len(points)
    rows = max(-(-count // _REMAP_COLUMNS), 1)
    x, y = np.zeros((2, rows * _REMAP_COLUMNS), np.float32)
    x[:count] = (points[:, 0] / TABLE_SIDE_M + 0.5) * width - 0.5
    y[:count] = (0.5 - points[:, 1] / TABLE_SIDE_M) * height - 0.5
    shape = (rows, _REMAP_COLUMNS)
    flat = cv2.remap(texture, x.reshape(shape), y.reshape(shape), cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE)
    return flat.reshape(-1, 3)[:count]


def lambert(
    albedo: Float[np.ndarray, "S 3"], cosine: Float[np.ndarray, "S"], visible: Float[np.ndarray, "S"], lamp: Lamp
) -> Float[np.ndarray, "S 3"]:
    """Radiance of matte surfaces.

    Args:
        albedo: linear, in [0, 1].
        cosine: n . l, times a near lamp's falloff and cone.
        visible: 1 where the light arrives, 0 in shadow.
        lamp: strengths of ambient and diffuse light, and their colour.
    """
    irradiance = lamp.intensity * (lamp.ambient + lamp.diffuse * np.maximum(cosine, 0) * visible)
    radiance = albedo * irradiance[:, None]
    return radiance if lamp.colour == WHITE else radiance * np.array(lamp.colour, radiance.dtype)
