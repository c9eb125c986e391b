"""Environments for programs that learn: importing this package registers them with Gymnasium.

    import gymnasium
    import osfcore.environments
    env = gymnasium.make("OSFTabletop-v0")

or in one call `gymnasium.make("osfcore.environments:OSFTabletop-v0")`, which processes of vectorised environments need.
Gymnasium has no entry points for packages since 1.0: a package registers its environments when it is imported.

Raises:
    MissingExtra: on import, if Gymnasium is not installed.
"""

from osfcore.extras import need

need("gym", "The environment")
import gymnasium  # noqa: E402

TABLETOP_ID = "OSFTabletop-v0"
ACTIONS = 30  # of 0.2 s before an episode is truncated, as in evaluations of rearrangement

if TABLETOP_ID not in gymnasium.registry:
    gymnasium.register(
        TABLETOP_ID, entry_point="osfcore.environments.tabletop_env:TabletopEnv", max_episode_steps=ACTIONS
    )
