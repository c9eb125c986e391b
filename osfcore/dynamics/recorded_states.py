"""Recorded episodes substep by substep, before anything is a tensor."""

from __future__ import annotations

import numpy as np
from jaxtyping import Bool

from osfcore.dynamics.pusher_path import SUBSTEPS
from osfcore.errors import InvalidInput
from osfcore.geometry.poses import Pose
from osfcore.geometry.workspace import TABLE_SIDE_M
from osfcore.io.push_file import PushEpisode

SLEEP_M = 1e-4  # an object that moves less than this in a substep, and turns less than that, rests
SLEEP_RAD = 2e-3
_SUNK_M = 0.02  # below the table's top: what lies there fell off
_EDGE_M = TABLE_SIDE_M / 2 - 0.05  # what comes nearer to the table's edge may fall: nothing to learn from


def substates(episode: PushEpisode) -> Pose:
    """All poses of an episode, substep by substep."""
    if episode.sub_positions is None or episode.sub_quaternions is None or episode.sub_positions.shape[1] != SUBSTEPS:
        raise InvalidInput("push file", "without poses within its actions", "one that 'osf collect pushes' wrote")
    positions = np.concatenate([episode.positions[:1], episode.sub_positions.reshape(-1, *episode.positions.shape[1:])])
    turned = episode.sub_quaternions.reshape(-1, *episode.quaternions.shape[1:])
    return Pose(positions, np.concatenate([episode.quaternions[:1], turned]))


def is_on_table(episode: PushEpisode) -> Bool[np.ndarray, "T1"]:
    """Whether all objects are on the table, away from its edge, before the first and after each action."""
    reach = np.abs(episode.positions[..., :2]).max(axis=(1, 2))
    return (reach < _EDGE_M) & (episode.positions[..., 2].min(axis=1) > -_SUNK_M)
