import cv2
import numpy as np

from osfcore.experiments.dynamics import write_gallery, write_plots
from tests.core.experiments.dynamics.test_report import report, scored
from tests.core.experiments.pushes import shapes


def test_curves_and_trajectories_are_drawn(tmp_path):
    two = report(by_set={"directed 3": scored(30.0), "paper 3": scored(1.0)})
    write_plots(tmp_path, two)
    write_gallery(tmp_path, two, shapes())
    curves, cells = (cv2.imread(str(tmp_path / f"{name}.png")) for name in ("dynamics", "trajectories"))
    assert curves is not None
    assert cells is not None
    assert curves.shape[1] > 2 * curves.shape[0]
    colours = (40, 39, 214), (44, 160, 44)
    red, green = ((np.abs(cells.astype(int) - colour) < 30).all(axis=-1).sum() for colour in colours)
    assert red > 200  # predicted
    assert green > 200  # true
