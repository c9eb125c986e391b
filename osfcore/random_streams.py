"""Independent random streams from one seed, one for each purpose.

A generator seeded with a list is no such stream: numpy pads its entropy with zeros, so that `[seed, n]` and
`[seed, n, 0]`, and a bare `seed` and `[seed, 0]`, draw the same numbers. Spawn keys are mixed in behind the padding,
and each purpose has a tag of its own in them. What has a single stream keeps the one without a key: a world's own
`reset(seed)`, and the training of a network.
"""

from __future__ import annotations

from enum import IntEnum, unique

import numpy as np


@unique
class Stream(IntEnum):
    """What a stream is drawn for. A value, once given, is never given to another purpose."""

    SCENE = 1  # objects, light and arrangement of scenes that fields and estimates are measured on
    FIRST_FRAME = 2
    TRACKING = 3
    MEASURED_PUSHES = 4  # pushes along which tracking is measured
    MEASURED_GOAL = 5  # goals whose estimates are measured
    SPOILED_INPUT = 6
    TASK_SCENE = 7  # objects, light and arrangement of a rearrangement task
    TASK_GOAL = 8  # where its objects shall lie
    TASK_GOAL_LIGHT = 9
    EPISODE = 10  # estimates and plans of Algorithm 1
    ORACLE = 11
    GOAL_LAYOUT = 12  # random goals of people
    COLLECTED_SCENE = 13
    COLLECTED_POLICY = 14
    COLLECTED_DISTURBANCE = 15
    COLLECTED_IMAGES = 16
    COLLECTED_NAMES = 17
    HELD_OUT_PUSHES = 18  # the seed of a collection that predictions are measured on
    BENCHMARK = 19
    LIGHT = 20  # of scenes whose objects lie where a person wants them
    BOOTSTRAP = 21
    FACTOR_LIGHT = 22
    COLLECTED_LIGHT = 70  # of trajectories whose frames are kept
    VIDEO_WINDOWS = 71  # which of them video prediction learns from, and how they are varied
    VIDEO_WEIGHTS = 72  # that video prediction begins with
    RELIT_SCENE = 80  # scenes that are shown under many lights, and the lights' azimuths
    VIDEO_SCENE = 81  # scenes that predicted videos begin with
    VIDEO_ESTIMATE = 82  # what is taken of them from images
    PHOTO_SEARCH = 90  # poses in photographs, and starts that are measured
    PHOTO_PLANE = 91  # of the table, from measured depth
    FACTOR_FRAME = 92  # what a factor leaves to chance in a measured first frame: wood, errors of cameras, noise
    PAPER_SCENE = 94  # scenes whose poses and light are estimated as published, under choices that its text leaves open
    UNROLLED_SCENE = 96  # scenes whose estimates are shown step by step
    SAMPLE_WOOD = 97  # of the table in the sample photograph
    DRAWN_PHOTO = 98  # tables in drawn photographs, their cameras, and what those do to a picture
    LAMP_SCENE = 95  # scenes under lamps that are estimated, and the photographs of them


def _sequence(seed: int, stream: Stream, numbers: tuple[int, ...]) -> np.random.SeedSequence:
    return np.random.SeedSequence(seed, spawn_key=(int(stream), *numbers))


def stream_rng(seed: int, stream: Stream, *numbers: int) -> np.random.Generator:
    """Return the generator of one stream.

    Args:
        seed: of everything random, 0 or more.
        stream: what is drawn.
        numbers: which of several, such as task and attempt.
    """
    return np.random.default_rng(_sequence(seed, stream, numbers))


def stream_seed(seed: int, stream: Stream, *numbers: int) -> int:
    """Return a 31-bit seed drawn from one stream, for code that takes a seed instead of a generator."""
    return int(_sequence(seed, stream, numbers).generate_state(1)[0] >> 1)
