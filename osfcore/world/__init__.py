"""The simulated tabletop, its pictures, and the data collected from it; the only room that knows PyBullet."""

from osfcore.extras import need

need("sim", "The simulated table")
