"""How far estimated lamps are from true ones, on things of known shape.

A ball called "gray" has the normals of a sphere and one albedo. Of anything else, normals and albedo come from all
its other images and their lamps (photometric stereo; Woodham 1980, the three darkest and the brightest value of each
pixel left out), and the lamp of the image that was left out is estimated.
"""

from __future__ import annotations

import numpy as np

from osfcore.experiments.photos.folders import LampSubject, sphere_normals
from osfcore.photo.light.lamp import ShadedPixels, fit_lamp

BALL = "gray"
_EVERY = 7  # of a thing's pixels
_DARKEST, _BRIGHTEST = 3, 1
_SATURATED, _LEAST_ALBEDO = 0.98, 0.05


def lamp_errors_deg(subject: LampSubject) -> list[float]:
    """Angle between estimated and true lamp of each image [deg]."""
    errors = []
    for number, (image, direction) in enumerate(zip(subject.images, subject.directions, strict=True)):
        albedo, normals, shown = _surface(subject, number)
        usable = shown & (image.max(axis=-1) < _SATURATED)
        pixels = ShadedPixels(*(a[usable][::_EVERY] for a in (image, albedo, normals)))
        cosine = float(fit_lamp(pixels).direction @ direction)
        errors.append(float(np.rad2deg(np.arccos(np.clip(cosine, -1, 1)))))
    return errors


def _surface(subject: LampSubject, left_out: int) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Albedo, normals and usable pixels of a thing, without one of its images."""
    if subject.name == BALL:
        normals, shown = sphere_normals(subject.mask)
        return np.ones_like(normals), normals, shown
    others = np.arange(len(subject.images)) != left_out
    images, lamps = subject.images[others], subject.directions[others]
    values = images[:, subject.mask].mean(axis=-1)
    order = np.argsort(values, axis=0)
    weights = np.ones_like(values)
    np.put_along_axis(weights, np.concatenate([order[:_DARKEST], order[-_BRIGHTEST:]]), 0, axis=0)
    normal = np.einsum("kp,ki,kj->pij", weights, lamps, lamps) + 1e-6 * np.eye(3)
    right = np.einsum("kp,ki,kp->pi", weights, lamps, values)
    scaled = np.linalg.solve(normal, right[..., None])[..., 0]
    grey = np.linalg.norm(scaled, axis=1)
    colour = images[:, subject.mask].mean(axis=0)
    colour /= np.maximum(colour.mean(axis=-1, keepdims=True), 1e-6)
    albedo, normals = np.zeros((*subject.mask.shape, 3)), np.zeros((*subject.mask.shape, 3))
    albedo[subject.mask] = grey[:, None] * colour
    normals[subject.mask] = scaled / np.maximum(grey[:, None], 1e-6)
    return albedo, normals, albedo.mean(axis=-1) > _LEAST_ALBEDO
