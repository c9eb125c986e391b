"""Makes the environments known to Gymnasium, which is an extra."""

from __future__ import annotations

from osfcore.extras import need

TABLETOP_ID = "OSFTabletop-v0"
ACTIONS = 30  # of 0.2 s before an episode is truncated, as in evaluations of rearrangement


def register() -> None:
    """Register the environments; again does nothing.

    Raises:
        MissingExtra: if there is nothing to register them with.
    """
    need("gym", "The environment")
    import gymnasium

    if TABLETOP_ID not in gymnasium.registry:
        entry = "osfcore.environments.tabletop_env:TabletopEnv"
        gymnasium.register(TABLETOP_ID, entry_point=entry, max_episode_steps=ACTIONS)
