"""The simulated tabletop, its pictures, and the data collected from it; the only room that knows PyBullet."""
