import numpy as np
import torch

from osfcore.dynamics.pusher_path import SUBSTEPS, pusher_path
from osfcore.dynamics.substep import advance
from osfcore.dynamics.unroll import unroll
from tests.core.dynamics.scenes import crowd, network, start, sweep_of

VELOCITY = torch.tensor([[[0.3, 0.0]], [[0.25, 0.1]], [[-0.1, 0.2]]])


def run(net, table, shapes, velocity=VELOCITY):
    number, motion = start(table, shapes, crowd(shapes))
    with torch.inference_mode():
        return list(unroll(net, table, number, motion, velocity))


def test_every_substep_is_told_and_the_pusher_goes_its_path(shapes, table):
    motions = run(network(), table, shapes)
    assert len(motions) == SUBSTEPS * len(VELOCITY)
    path = pusher_path(np.zeros(2), VELOCITY[:, 0].numpy())
    found = torch.cat([m.pusher for m in motions]).numpy()
    np.testing.assert_allclose(found, path[1:], atol=1e-6)


def test_one_substep_is_one_advance(shapes, table):
    net = network()
    number, motion = start(table, shapes, crowd(shapes))
    with torch.inference_mode():
        expected = advance(net, table, number, motion, sweep_of(motion, (0.3, 0.0)))
    torch.testing.assert_close(run(net, table, shapes)[0], expected)


def test_a_longer_plan_begins_as_a_shorter_one(shapes, table):
    net = network()
    short, long = run(net, table, shapes, VELOCITY[:1]), run(net, table, shapes)
    for a, b in zip(short, long, strict=False):
        assert torch.equal(a.centre, b.centre)


def test_going_on_from_the_middle_is_going_on(shapes, table):
    net = network()
    whole = run(net, table, shapes)
    number, _ = start(table, shapes, crowd(shapes))
    with torch.inference_mode():
        rest = list(unroll(net, table, number, whole[SUBSTEPS - 1], VELOCITY[1:]))
    torch.testing.assert_close(rest[-1], whole[-1])
