"""The table, the workspace, the pusher and its actions: dimensions and limits [m, m/s, s].

World frame: z up, table top at z = 0, its centre the origin.
"""

from __future__ import annotations

import numpy as np
from jaxtyping import Float

from osfcore.errors import InvalidInput, finite_vector

TABLE_SIDE_M = 1.2
WORKSPACE_HALF_M = 0.22
PUSHER_RADIUS_M = 0.015
PUSHER_HEIGHT_M = 0.12
PUSHER_ALBEDO = (0.22, 0.42, 0.50)  # known, as a robot knows its hand
PUSHER_CLEARANCE_M = 0.002  # the pusher hovers, so that it never rubs on the table
PUSHER_CENTRE_Z_M = PUSHER_CLEARANCE_M + PUSHER_HEIGHT_M / 2
PUSHER_REACH_M = 0.35  # |x|, |y| of the pusher's centre; the robot stops there
MAX_SPEED_M_S = 0.3
STEP_S = 0.2
ACTION_ALLOWED = f"(vx, vy, 0), finite, with |vx| and |vy| at most {MAX_SPEED_M_S}"


def check_action(action: object) -> Float[np.ndarray, "3"]:
    """Return a velocity (vx, vy, 0) of the pusher [m/s], held for `STEP_S`, after checking it.

    Raises:
        InvalidInput: if it is not three finite numbers, exceeds 0.3 m/s on an axis or has a vertical part.
    """
    velocity = finite_vector(action, 3, "action [m/s]")
    if np.any(np.abs(velocity) > MAX_SPEED_M_S + 1e-9) or velocity[2] != 0:
        raise InvalidInput("action [m/s]", velocity.tolist(), ACTION_ALLOWED)
    return velocity
