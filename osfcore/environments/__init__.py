"""Environments for programs that learn: importing this room registers them with Gymnasium.

    import gymnasium
    import osfcore.environments
    env = gymnasium.make("OSFTabletop-v0")

or in one call `gymnasium.make("osfcore.environments:OSFTabletop-v0")`, which processes of vectorised environments need.
Gymnasium has no entry points for packages since 1.0: a package registers its environments when it is imported.

Raises:
    MissingExtra: on import, if it is not installed.
"""

from osfcore.environments.registration import register

register()
