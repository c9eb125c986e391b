"""The simulated tabletop for LeRobot: importing this makes `--env.type=osf` known.

LeRobot 0.6 does so by itself where the package is installed, for its name; before,
`--env.discover_packages_path=lerobot_env_osf` asks for it.
"""

import gymnasium

from lerobot_env_osf.config import GYM_ID, OsfEnv

__all__ = ["GYM_ID", "OsfEnv"]

if GYM_ID not in gymnasium.registry:
    # LeRobot reads attributes of the outermost environment: nothing may be wrapped around it.
    entry = "lerobot_env_osf.environment:LeRobotTabletop"
    gymnasium.register(GYM_ID, entry_point=entry, order_enforce=False, disable_env_checker=True)
