"""Makes the environments known to Gymnasium, which is an extra."""

from __future__ import annotations

from importlib.util import find_spec

from osfcore.errors import OsfError

TABLETOP_ID = "OSFTabletop-v0"
ACTIONS = 30  # of 0.2 s before an episode is truncated, as in evaluations of rearrangement


class MissingGymnasium(OsfError):
    """Gymnasium is not installed."""

    def __init__(self) -> None:
        super().__init__("Environments need Gymnasium; install it with: pip install 'osf-manipulation[gym]'.")


def register() -> None:
    """Register the environments; again does nothing.

    Raises:
        MissingGymnasium: if there is nothing to register them with.
    """
    if find_spec("gymnasium") is None:
        raise MissingGymnasium
    import gymnasium

    if TABLETOP_ID not in gymnasium.registry:
        entry = "osfcore.environments.tabletop_env:TabletopEnv"
        gymnasium.register(TABLETOP_ID, entry_point=entry, max_episode_steps=ACTIONS)
