"""What the page lets people enter is what REST takes, no more and no less."""

import re
from html.parser import HTMLParser

import pytest

from app.api.app_factory import create_app
from app.services.scenes import MAX_SEED
from app.storage.paths import static_folder
from osfcore.world.collect_images import MAX_IMAGES, MIN_IMAGES
from tests.app.api.test_jobs import finished
from tests.app.api.test_problems import is_problem

SCHEMA = create_app().openapi()
# Fields of the page's forms by name, with every place to which what is entered there is sent.
NUMBERS = {
    "table-count": ["SceneIn.count"],
    "count": ["SceneIn.count"],
    "seed": [
        "SceneIn.seed", "EstimateIn.seed", "TrainFieldParams.seed", "CollectPushesParams.seed",
        "CollectObjectParams.seed", "CollectTableParams.seed",
    ],
    "images": ["TrainFieldParams.images", "CollectObjectParams.images", "CollectTableParams.images"],
    "minutes": ["TrainFieldParams.minutes"],
    "focal": ["PhotoPatch.focal_px"],
    "episodes": ["CollectPushesParams.episodes"],
    "steps": ["CollectPushesParams.steps"],
    "objects": ["CollectPushesParams.objects"],
    "x_m": ["PlaceIn.x_m"],
    "y_m": ["PlaceIn.y_m"],
    "turn_deg": ["PlaceIn.turn_deg"],
    "robot-steps": ["RobotSettingsIn.steps"],
    "size": ["CollectObjectParams.size", "CollectTableParams.size"],
}  # fmt: skip
QUERIES = {
    "grams": ("/api/objects", "mass_kg", 1000),
    "label": ("/api/objects", "label", 1),
    "calibration-board": ("/api/calibration/photos", "board", 1),
}
NUMBERS_AS_TEXT = ("box",)  # taken apart by the page
TEXTS = {"draft-name": "DraftKeep.name", "name": "TrainFieldParams.name", "board": "PhotoPatch.board"}


def source(name):
    return (static_folder() / name).read_text(encoding="utf-8")


class Inputs(HTMLParser):
    """Attributes of all inputs of the page."""

    def __init__(self):
        super().__init__()
        self.found = []
        self.feed(source("index.html"))

    def handle_starttag(self, tag, attrs):
        if tag == "input":
            self.found.append(dict(attrs))

    def of_type(self, kind):
        return [entry for entry in self.found if entry.get("type") == kind]


def property_of(place):
    """One property of a model, without the null that it may be."""
    model, name = place.split(".")
    found = SCHEMA["components"]["schemas"][model]["properties"][name]
    return next((kind for kind in found.get("anyOf", ()) if kind.get("type") != "null"), found)


def query_of(method, path, name):
    parameters = SCHEMA["paths"][path][method]["parameters"]
    schema = next(one for one in parameters if one["name"] == name)["schema"]
    return next((kind for kind in schema.get("anyOf", ()) if kind.get("type") != "null"), schema)


def entered():
    """Name, least and most of every number that can be entered, on the page and in the forms that scripts draw."""
    for entry in Inputs().of_type("number"):
        yield entry.get("name") or entry["id"], float(entry["min"]), float(entry["max"])
    for name, least, most in re.findall(r'number\("(\w+)", "[^"]+", \d+, (\d+), (\d+)\)', source("js/jobs.js")):
        yield name, float(least), float(most)


def test_every_number_that_can_be_entered_has_the_bounds_that_rest_states():
    numbers = list(entered())
    assert {name for name, _, _ in numbers} == {*NUMBERS, "grams"}
    assert len(numbers) == len(Inputs().of_type("number")) + len(
        re.findall(r"^    number\(", source("js/jobs.js"), re.M)
    )
    for name, *bounds in numbers:
        if name in QUERIES:
            path, parameter, factor = QUERIES[name]
            stated = query_of("post", path, parameter)
            assert bounds == pytest.approx([factor * stated["minimum"], factor * stated["maximum"]])
            continue
        for place in NUMBERS[name]:
            stated = property_of(place)
            assert bounds == [stated["minimum"], stated["maximum"]], (name, place)


def test_every_text_that_can_be_entered_is_as_long_as_rest_allows():
    texts = Inputs().of_type("text")
    named = [(entry.get("name") or entry["id"], entry) for entry in texts]
    assert {name for name, _ in named} == {*TEXTS, *NUMBERS_AS_TEXT, "label", "calibration-board"}
    for name, entry in named:
        if name in QUERIES:
            path, parameter, _ = QUERIES[name]
            assert int(entry["maxlength"]) == query_of("post", path, parameter)["maxLength"]
        elif name not in NUMBERS_AS_TEXT:
            assert int(entry["maxlength"]) == property_of(TEXTS[name])["maxLength"], name


def test_what_scripts_cut_off_or_count_is_what_rest_states():
    def stands(name, pattern):
        (found,) = set(re.findall(pattern, source(f"js/{name}.js")))
        return int(found.replace("_", ""))

    assert stands("scenes", r"MOST_OBJECTS = (\d+)") == property_of("SceneIn.objects")["maxItems"]
    assert stands("scenes", r"Math\.random\(\) \* ([\d_]+)") <= property_of("SceneIn.seed")["maximum"]
    assert stands("goals", r"DRAWN_SEEDS = ([\d_]+)") <= property_of("RandomLayout.seed")["maximum"]
    for path in ("/api/pictures", "/api/goals", "/api/photos"):
        assert stands("picture", r"NAME_MAX = (\d+)") == query_of("post", path, "name")["maxLength"]
    assert stands("fields", r"slice\(-(\d+)\)") == query_of("post", "/api/fields/sets", "file_name")["maxLength"]
    assert stands("estimate", r"slice\(-(\d+)\)") == query_of("post", "/api/estimates", "file_name")["maxLength"]
    assert stands("api", r"limit: (\d+)") == query_of("get", "/api/goals", "limit")["maximum"]
    assert stands("episodes", r"MOST = (\d+)") == query_of("get", "/api/episodes", "limit")["maximum"]


def test_an_image_set_may_have_as_many_images_as_collecting_takes():
    stated = property_of("CollectTableParams.images")
    assert (stated["minimum"], stated["maximum"]) == (MIN_IMAGES, MAX_IMAGES)


def test_all_seeds_have_the_same_bounds():
    models = SCHEMA["components"]["schemas"]
    inputs = [f"{name}.seed" for name in models if "seed" in models[name].get("properties", {})]
    stated = [property_of(place) for place in inputs if "maximum" in property_of(place)]
    stated.append(query_of("post", "/api/estimates", "seed"))
    assert len(stated) >= 8
    assert {(kind["minimum"], kind["maximum"]) for kind in stated} == {(0, MAX_SEED)}


@pytest.mark.slow
@pytest.mark.parametrize("seed", [0, MAX_SEED])
def test_whoever_takes_a_seed_takes_the_first_and_the_last(service, seed):
    scene = service.post("/api/scenes", json={"seed": seed, "count": 2, "image_size": 16})
    assert (scene.status_code, scene.json()["seed"]) == (201, seed)
    place = f"/api/scenes/{scene.json()['id']}"
    goal = service.post("/api/goals", json={"scene": scene.json()["id"], "random": {"seed": seed, "moved": 1}})
    assert goal.status_code == 201
    for kind, params in (
        ("collect_table", {"images": 60, "size": 16}),
        ("collect_pushes", {"episodes": 1, "steps": 2, "objects": 1}),
    ):
        asked = service.post("/api/jobs", json={"kind": kind, "params": {**params, "seed": seed}})
        job = finished(service, asked.headers["location"])
        assert (job["state"], job["error"]) == ("done", None)
    service.delete(f"/api/goals/{goal.json()['id']}")
    service.delete(place)


@pytest.mark.parametrize("seed", [-1, MAX_SEED + 1])
def test_seeds_beyond_are_refused(service, seed):
    for path, body in (
        ("scenes", {"seed": seed}),
        ("goals", {"random": {"seed": seed}}),
        ("estimates", {"seed": seed}),
        ("episodes", {"goal": "g", "seed": seed}),
        ("jobs", {"kind": "collect_table", "params": {"seed": seed}}),
    ):
        assert "seed" in is_problem(service.post(f"/api/{path}", json=body), 422)["errors"][0]["pointer"]
