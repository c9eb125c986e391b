"""How well a field shows its object: unseen views under unseen lights, over black."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np

from osfcore.fields.kiloosf import KiloOSF
from osfcore.inspection.contact_sheet import Comparison
from osfcore.io.image_file import to_uint8
from osfcore.io.image_set import ImageSet
from osfcore.metrics.image_errors import dilated, psnr, ssim
from osfcore.render.scene_renderer import SceneRenderer
from osfcore.render.types import EXACT, Quality, SceneBatch

VIEW_QUALITY: Quality = EXACT  # one ray a pixel, as in training
_NAME = "object"


@dataclass(frozen=True, eq=False, slots=True)
class ViewFigures:
    """One image, compared.

    Attributes:
        psnr_full: over the whole image, premultiplied over black [dB].
        psnr_mask: inside the silhouette, dilated by 2 px [dB].
        ssim: over the whole image.
        comparison: both images.
    """

    psnr_full: float
    psnr_mask: float
    ssim: float
    comparison: Comparison


def compare_views(field: KiloOSF, images: ImageSet) -> Iterator[ViewFigures]:
    """Render each image of a set from its camera under its light, with the object where the set has it."""
    renderer = SceneRenderer({_NAME: field}, None)
    place, turn = np.zeros((1, 1, 3)), np.array([[[1.0, 0.0, 0.0, 0.0]]])
    for camera, light, rgba in zip(images.cameras, images.light_directions, images.rgba, strict=True):
        batch = SceneBatch((_NAME,), place, turn, light[None].astype(float), None)
        rendered = renderer.render(batch, (camera,), quality=VIEW_QUALITY)
        ours = np.clip(rendered.rgb[0, 0], 0, 1)
        truth = rgba[..., :3].astype(np.float32) * rgba[..., 3:] / 255**2
        shown = Comparison(camera.name.rpartition("/")[2], to_uint8(truth), to_uint8(ours))
        inside = dilated(rgba[..., 3] > 0)
        yield ViewFigures(psnr(truth, ours), psnr(truth, ours, inside), ssim(truth, ours), shown)
