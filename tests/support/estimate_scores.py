"""Handmade scores, for figures and pictures that are made of them."""

from osfcore.experiments.estimation import EstimateReport, FrameScore, ObjectScore, TrackScore
from osfcore.experiments.estimation_tasks import KINDS, BadScore


def score(position_mm=1.0, rotation_deg=1.0, *, flagged=False, ratios=(1.0, 1.0, 1.0), name="can", std_mm=1.0):
    doubt = "it is hardly visible" if flagged else ""
    return ObjectScore(name, position_mm, rotation_deg, 0.5, std_mm, ratios, ratios, flagged, doubt)


def frame(*objects, light=(0.5, 0.5), seconds=2.0):
    return FrameScore(tuple(o.name for o in objects), objects, 1.0, light, seconds, True)


def track(*position, rotation=0.0, absent="", right=True, refused="", seconds=0.5):
    """A track of objects with these errors [mm] at each step."""
    rows = tuple(zip(*position, strict=True))
    count, steps = len(position), len(rows)
    return TrackScore(
        names=tuple("abc"[:count]),
        right_at_start=(right,) * count,
        position_mm=rows,
        rotation_deg=((rotation,) * count,) * steps,
        absent=((absent,) * count,) * steps,
        doubted=((False,) * count,) * steps,
        seconds=(seconds,) * steps,
        moved_m=(0.06,) * count,
        refused=refused,
    )


def report():
    """Two tasks of two objects, with everything measured."""
    good, bad = frame(score(), score(2.0)), frame(score(), score(20.0, 170.0, flagged=True), light=(9.0, 9.0))
    return EstimateReport(
        first=(good, bad),
        tracks=(track([1.0] * 20, [2.0] * 20), track([1.0] * 20, [2.0] * 10 + [50.0] * 10)),
        goals=((good, bad), (good, good)),
        fixed_light=(bad, bad),
        views={1: (bad, bad), 2: (good, bad)},
        bad=(BadScore(KINDS[0], "", "", False, (50.0,), (3.0,), 1.0), BadScore(KINDS[1], "no", "", False)),
    )
