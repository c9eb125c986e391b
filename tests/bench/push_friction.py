"""Friction of a sliding object, from forces that were measured in pushes of a real one.

python -m tests.bench.push_friction LOGS

LOGS is the folder PushExp/sensor_log of https://github.com/robinzhoucmu/MLab_EXP, logs of 500 pushes on paperboard and
plywood (Zhou, Paolini, Bagnell and Mason: A convex polynomial force-motion model for planar sliding, ICRA 2016). An
aluminium triangle of 1.518 kg (their demo_multilog_robot_exp.m) stood on three screws or on a patch. While it slides
without turning, the pushing force is the weight times the coefficient of friction, however pressure is distributed.
"""

from collections import defaultdict
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import tyro

_WEIGHT_N = 1.518 * 9.8
_LEAST_MM, _MOST_DEG = 5.0, 2.5  # of a push that counts as a translation
_BEFORE = 20  # readings before contact, whose mean is the sensor's offset
_SLIDING = 0.6  # of the readings, from which on the object has long been moving


@dataclass(frozen=True)
class Arguments:
    logs: tyro.conf.Positional[Path]
    """Folder of the logs."""


def translations(log: Path) -> list[float]:
    """Return force over weight of each push of a log that hardly turned the object."""
    numbers = iter(map(float, log.read_text().split()))

    def table(columns: int, rows: int | None = None) -> np.ndarray:
        rows = int(next(numbers)) if rows is None else rows
        return np.array([next(numbers) for _ in range(rows * columns)]).reshape(rows, columns)

    found = []
    for _ in range(int(next(numbers))):
        (before,), (after,) = table(7, rows=1), table(7, rows=1)  # x, y, z [mm], quaternion
        force = table(3)[:, 1:]  # after the time: along x and y [N]
        table(8)  # poses of the robot
        force = np.linalg.norm(force - force[:_BEFORE].mean(axis=0), axis=1)
        turned = 2 * np.degrees(np.arccos(np.clip(abs(before[3:] @ after[3:]), 0, 1)))
        if np.linalg.norm((after - before)[:2]) > _LEAST_MM and turned < _MOST_DEG:
            late = force[int(_SLIDING * len(force)) :]
            found.append(float(np.median(late[late > force.mean()])) / _WEIGHT_N)
    return found


def main() -> None:
    """Print the quartiles of the coefficient on each surface."""
    found = defaultdict(list)
    for log in sorted(tyro.cli(Arguments).logs.glob("*/exp_*_50*.txt")):
        found["plywood" if log.parent.name.startswith("wood") else "paperboard"] += translations(log)
    for surface, coefficients in found.items():
        low, middle, high = np.percentile(coefficients, (25, 50, 75))
        print(f"{surface}: {len(coefficients)} translations, friction {middle:.2f} (quartiles {low:.2f} to {high:.2f})")


if __name__ == "__main__":
    main()
