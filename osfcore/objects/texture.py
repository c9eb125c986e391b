"""Textures without traces of their background: reduced by a coverage-weighted filter, filled around the charts.

Scanned textures show their charts on black. A plain filter or mip map would pull that black into the charts' rims; here
only texels that a face covers count, and all others continue the colours of their neighbours.
"""

import cv2
import numpy as np
from jaxtyping import Float, Int, UInt8

MAX_TEXTURE_SIDE = 2048
_SUBPIXEL_BITS = 4
_RIM_TEXELS = 2  # JPEG mixes the background into this many texels of a chart's rim


def coverage(
    uv: Float[np.ndarray, "P 2"], faces: Int[np.ndarray, "F 3"], width: int, height: int
) -> UInt8[np.ndarray, "height width"]:
    """1 for each texel that a face touches, else 0; first row at v = 1.

    Args:
        uv: texture coordinates of the vertices, v upwards; what lies outside [0, 1] is cut off.
        faces: vertex indices.
        width: of the texture [texels].
        height: of the texture [texels].
    """
    mask = np.zeros((height, width), np.uint8)
    pixels = np.stack([uv[:, 0] * width, (1 - uv[:, 1]) * height], axis=1) - 0.5
    corners = np.round(pixels * 2**_SUBPIXEL_BITS).astype(np.int32)[faces]
    for triangle in corners:
        cv2.fillConvexPoly(mask, triangle, 1, lineType=cv2.LINE_8, shift=_SUBPIXEL_BITS)
    return mask


def _fill(image: Float[np.ndarray, "h w 3"], weight: Float[np.ndarray, "h w"]) -> Float[np.ndarray, "h w 3"]:
    """Push-pull: texels of no weight take the smoothly interpolated colour of those that have some."""
    height, width = weight.shape
    if weight.all() or (height == 1 and width == 1):
        return image
    size = ((width + 1) // 2, (height + 1) // 2)
    coarse_weight = cv2.resize(weight, size, interpolation=cv2.INTER_AREA)
    coarse = cv2.resize(image * weight[..., None], size, interpolation=cv2.INTER_AREA)
    coarse /= np.maximum(coarse_weight, 1e-12)[..., None]
    coarse = _fill(coarse, (coarse_weight > 0).astype(np.float32))
    smooth = cv2.resize(coarse, (width, height), interpolation=cv2.INTER_LINEAR)
    return np.where(weight[..., None] > 0, image, smooth)


def _without_rim(covered: UInt8[np.ndarray, "h w"], texels: int) -> UInt8[np.ndarray, "h w"]:
    """The charts less their rims, into which the background is mixed; charts that are nothing but rim stay."""
    inner = cv2.erode(covered, np.ones((2 * texels + 1, 2 * texels + 1), np.uint8), borderValue=1)
    near = cv2.dilate(inner, np.ones((4 * texels + 3, 4 * texels + 3), np.uint8))
    return np.maximum(inner, covered & (1 - near))


def clean_texture(
    texture: UInt8[np.ndarray, "h w 3"],
    uv: Float[np.ndarray, "P 2"],
    faces: Int[np.ndarray, "F 3"],
    max_side: int = MAX_TEXTURE_SIDE,
) -> UInt8[np.ndarray, "h2 w2 3"]:
    """The texture, reduced if need be, with everything outside the charts filled from their rims.

    A covered texel of the result is the mean of the covered texels beneath it. A texture of which no face covers
    anything comes back as it is.

    Args:
        texture: RGB.
        uv: texture coordinates of the vertices, v upwards.
        faces: vertex indices.
        max_side: longest side of the result [texels].
    """
    height, width = texture.shape[:2]
    covered = coverage(uv, faces, width, height)
    if not covered.any():
        return texture
    weight = _without_rim(covered, _RIM_TEXELS if max(height, width) > max_side else 1).astype(np.float32)
    image = texture.astype(np.float32)
    scale = max_side / max(height, width)
    if scale < 1:
        target = (max(round(width * scale), 1), max(round(height * scale), 1))
        reduced = cv2.resize(image * weight[..., None], target, interpolation=cv2.INTER_AREA)
        weight = cv2.resize(weight, target, interpolation=cv2.INTER_AREA)
        image = reduced / np.maximum(weight, 1e-12)[..., None]
    filled = _fill(image, weight)
    return np.clip(np.round(filled), 0, 255).astype(np.uint8)
