import json

import numpy as np
import pytest

import osfcore.experiments.bench_rendering as module
from osfcore.errors import InvalidInput, MissingAssets
from osfcore.experiments.bench_rendering import BenchRender, bench_render, lay_out, rollouts, slope
from osfcore.geometry.light import Light
from osfcore.objects.asset_library import AssetLibrary
from tests.support.errors import about
from tests.support.solids import SOLIDS

TINY = BenchRender(scenes=3, repeats=1, counts=(1, 5), sides=(32, 48), batches=(1, 4), side=32)


@pytest.mark.slow
def test_every_figure_is_there_and_both_renderers_draw_the_same_scene(solids, library, monkeypatch):
    monkeypatch.setattr(module, "CANDIDATES", 3)
    steps = list(bench_render(TINY, solids, library))
    assert [step.done for step in steps] == [0, 0, 1, 2, 3, 4, 5, 6]
    report = steps[-1].report
    result = json.loads(json.dumps(report.figures))
    for key in ("tinyrenderer_ms", "scene_ms", "scene_exact_ms", "planning_renders_per_s", "reference_ms"):
        assert result[key] > 0
    assert result["ratio"] == pytest.approx(result["tinyrenderer_ms"] / result["scene_ms"])
    assert result["planning_psnr"] > 25
    for key, sizes in (("by_objects", [1, 5]), ("by_resolution", [32, 48]), ("by_batch", [1, 4])):
        assert [row["size"] for row in result[key]] == sizes
        assert all(row["ms"] > 0 for row in result[key])
    assert result["by_batch"][1]["ms_per_image"] == pytest.approx(result["by_batch"][1]["ms"] / 4)
    # TinyRenderer has shadows of its own kind and no smooth edges, but what sets each of its images apart from the
    # others sets ours apart too.
    theirs, ours = (np.array([getattr(c, which).ravel() for c in report.shown], float) for which in ("truth", "ours"))
    count = len(report.shown)
    likeness = np.corrcoef(theirs - theirs.mean(axis=0), ours - ours.mean(axis=0))[:count, count:]
    np.testing.assert_array_equal(likeness.argmax(axis=1), np.arange(count))


def test_the_slope_is_the_power_of_growth():
    sizes = [1, 2, 4, 16]
    assert slope(sizes, [3 * n**1.5 for n in sizes]) == pytest.approx(1.5)
    assert slope([5], [1.0]) is None


def test_every_planning_image_has_moved_an_object(library):
    rng = np.random.default_rng(0)
    start = lay_out([library.load(name) for name in SOLIDS], rng)
    light = Light.random(rng)
    batch = rollouts(start, light, SOLIDS, rng, 64, 10)
    assert batch.pusher is None  # goal views leave it out
    assert np.all(batch.lights == light.direction)
    moved = np.linalg.norm(batch.positions - start.position, axis=-1).reshape(64, 10, 3)
    assert np.all(moved.max(axis=-1) > 0.01)
    assert np.all(np.diff(moved.max(axis=-1), axis=1) > 0.01)  # a new image at every step
    assert set((moved[:, 0] > 0).sum(axis=-1)) == {1, 2}
    assert np.all((moved[:, 0] > 0).any(axis=0))
    np.testing.assert_allclose(np.linalg.norm(batch.quaternions, axis=-1), 1, atol=1e-12)


def test_what_cannot_be_measured_is_refused(solids, library, tmp_path):
    for config, what in (
        (BenchRender(repeats=0), "repeats"),
        (BenchRender(scenes=0), "new scenes"),
        (BenchRender(seed=-1), "seed"),
    ):
        with pytest.raises(InvalidInput, check=about(what)):
            next(bench_render(config, solids, library))
    with pytest.raises(MissingAssets):
        list(bench_render(TINY, solids, AssetLibrary(tmp_path)))
