"""The simulated tabletop, its pictures, and the data collected from it; only here are PyBullet and MuJoCo known."""

from osfcore.extras import need

need("sim", "The simulated table")
