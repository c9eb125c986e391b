"""The choice of a physics engine: PyBullet is the paper's simulator; MuJoCo runs under every Python."""

from __future__ import annotations

from collections.abc import Mapping
from importlib.util import find_spec
from typing import Literal, get_args

from osfcore.errors import InvalidInput
from osfcore.extras import MissingExtra
from osfcore.world.physics import BodyModel, Physics

Simulator = Literal["pybullet", "mujoco"]


def default_simulator() -> Simulator:
    """Return PyBullet, the simulator of the paper and of the published figures, or MuJoCo where that is missing."""
    return "mujoco" if find_spec("pybullet") is None else "pybullet"


def check_simulator(simulator: str) -> None:
    """Check that a simulator is known and installed.

    Raises:
        InvalidInput: if there is no such simulator.
        MissingExtra: if it is not installed.
    """
    if simulator not in get_args(Simulator):
        raise InvalidInput("simulator", repr(simulator), '"pybullet" or "mujoco"')
    if find_spec(simulator) is None:
        raise MissingExtra(f"The simulator {simulator}", "sim", [simulator])


def simulate(
    models: Mapping[str, BodyModel], simulator: Simulator, *, friction_factor: float = 1.0, mass_factor: float = 1.0
) -> Physics:
    """Start a simulation.

    Args:
        models: the objects that take part, by name.
        simulator: the physics engine.
        friction_factor: on the friction of the objects.
        mass_factor: on their masses and moments of inertia.

    Raises:
        InvalidInput: if there is no such simulator.
        MissingExtra: if it is not installed.
    """
    check_simulator(simulator)
    if simulator == "mujoco":
        from osfcore.world.mujoco_physics import MujocoPhysics as Engine
    else:
        from osfcore.world.bullet_physics import BulletPhysics as Engine
    return Engine(models, friction_factor=friction_factor, mass_factor=mass_factor)
