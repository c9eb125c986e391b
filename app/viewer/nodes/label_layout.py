"""Where names stand in the 3D view, so that none covers another as the view is at first."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float

from app.viewer.nodes.room import VIEW_AT, VIEW_FOV_RAD, VIEW_FROM
from osfcore.geometry.cameras import Camera

CHARACTER, LINE = 0.011, 0.032  # width of a character and height of a label, as shares of the view's height
_RISE_M = 0.02


@dataclass(frozen=True, slots=True, eq=False)
class Label:
    """A label in the 3D view.

    Attributes:
        text: what it says.
        anchor_m: the middle of its foot, in the world [m].
    """

    text: str
    anchor_m: Float[np.ndarray, "3"]


def separated(
    anchors_m: Float[np.ndarray, "N 3"], texts: Sequence[str], standing: Sequence[Label] = ()
) -> Float[np.ndarray, "N 3"]:
    """Anchors of labels, raised where one would cover another.

    A label stands on its anchor. From the lowest in the view to the highest, each is raised until it is clear of those
    before it.

    Args:
        anchors_m: where each would stand best, in the world [m].
        texts: of the labels.
        standing: labels that are on view already, and stay.
    """
    view = Camera.look_at("view", VIEW_FROM, VIEW_AT, fov_y_deg=float(np.rad2deg(VIEW_FOV_RAD)))
    place = view.project(anchors_m) / view.height
    higher = view.project(anchors_m + np.array([0, 0, _RISE_M])) / view.height
    raised = anchors_m.copy()
    taken: list[tuple[float, float, float]] = []  # middle, half width and foot of labels that have their place
    for label in standing:
        middle, foot = view.project(label.anchor_m[None])[0] / view.height
        taken.append((middle, CHARACTER * len(label.text) / 2, foot))
    for n in np.argsort(-place[:, 1], kind="stable"):
        (middle, foot), half = place[n], CHARACTER * len(texts[n]) / 2
        for other_middle, other_half, other_foot in sorted(taken, key=lambda label: -label[2]):
            if abs(middle - other_middle) < half + other_half and abs(foot - other_foot) < LINE:
                foot = other_foot - LINE
        raised[n, 2] += _RISE_M * (place[n, 1] - foot) / (place[n, 1] - higher[n, 1])
        taken.append((middle, half, foot))
    return raised
