"""What REST allows, least and most, in one place; bounds of the core are taken from there.

OpenAPI tells all of them. The page writes some down again, in static/index.html and static/js; a test compares.
"""

from typing import Any

from app.services.scenes import MAX_SEED
from osfcore.control.events import MAX_STEPS
from osfcore.geometry.cameras import MAX_IMAGE_SIDE, MIN_IMAGE_SIDE
from osfcore.geometry.rollouts import MAX_HORIZON, MAX_SEQUENCES
from osfcore.geometry.states import MAX_OBJECTS
from osfcore.geometry.workspace import TABLE_SIDE_M
from osfcore.objects.fetch import MAX_MASS_KG, MAX_TEXT
from osfcore.photo.calibration import MOST_PHOTOS

Bounds = tuple[float, float]

# Numbers
SEED = (0, MAX_SEED)
IMAGE_SIDE = (MIN_IMAGE_SIDE, MAX_IMAGE_SIDE)  # [px]
COORDINATE_M = (-100, 100)  # far beyond any table: keeps numbers away whose squares overflow
QUATERNION_COMPONENT = (-1.1, 1.1)
VIEW = (0, 1000)  # number of a camera
STEP = (0, 100_000)  # number of a step of an episode
GUESS = (1, 100_000)  # number of a step of an estimate
PAGE = (1, 500)  # entries of a list told at once
CURSOR = (0, 2**53)

# Counts
OBJECTS = (1, MAX_OBJECTS)  # of a scene, a goal or a state
ACTIONS = (1, 50)  # pushes by hand in one request
FETCHED = (0, 64)  # names of objects to fetch

# Lengths of texts
NAME = (1, 64)  # also of identifiers
VISITOR = "[A-Za-z0-9_-]+"  # what a page calls itself
GOAL_NAME = (1, 100)  # of episodes, too
SEARCH = (0, 200)
FILE_NAME = (0, 200)
CAMERA_JSON = (0, 4000)
CURSOR_TEXT = (0, 200)

LABEL = (0, MAX_TEXT)  # names of objects for people, licences

# Objects
MASS_KG = (0.0001, MAX_MASS_KG)
SCALE = (1e-6, 1e6)  # metres for one unit of a file

# Episodes
STEPS = (1, MAX_STEPS)
SAMPLES = (8, MAX_SEQUENCES)
HORIZON = (1, MAX_HORIZON)
TEMPERATURE = (1e-6, 1e6)

# Replays
REPLAY_S = (0, 86_400)
REPLAY_SPEED = (0.1, 16)

# Predictions
SEQUENCES = (1, 1000)

# Photos of tables
PIXEL = (0, 100_000)
FOCAL = (1, 100_000)
BRUSH = (0.1, 1000)
CLICKS = (0, 50)
STROKES = (0, 50)
STROKE_POINTS = (1, 500)
TOGETHER = (0, 8)
POSE_CHOICE = (0, 100)
BOARD_PHOTOS = (0, MOST_PHOTOS)
BOARD_PLACE_M = (-TABLE_SIDE_M / 2, TABLE_SIDE_M / 2)
BOARD_TURN_DEG = (-360, 360)

# Jobs
PUSH_EPISODES = (1, 100_000)
PUSH_STEPS = (1, 1000)
IMAGES = (60, 5000)  # of an image set
TRAINING_MINUTES = (0.1, 1440)


def within(bounds: Bounds) -> dict[str, Any]:
    """Arguments of `Field`, `Query` and `Path` for a number."""
    return {"ge": bounds[0], "le": bounds[1]}


def sized(bounds: tuple[int, int]) -> dict[str, Any]:
    """Likewise for a text or a list."""
    return {"min_length": bounds[0], "max_length": bounds[1]} if bounds[0] else {"max_length": bounds[1]}
