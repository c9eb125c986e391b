from dataclasses import dataclass

import pytest

from app.api.paging import page
from tests.app.api.test_problems import is_problem
from tests.app.conftest import keep_busy

LISTS = {
    "jobs": "jobs",
    "episodes": "episodes",
    "estimates": "estimates",
    "goals": "goals",
    "scenes": "scenes",
    "fields/sets": "sets",
}


@dataclass
class Made:
    id: str
    created_at: str


ENTRIES = [Made(name, f"2026-01-0{1 + number // 2}T00:00:00.000Z") for number, name in enumerate("abcdef")]


@pytest.mark.parametrize(("newest_first", "order"), [(True, "fedcba"), (False, "abcdef")])
def test_pages_put_together_are_the_list(newest_first, order):
    seen, after = "", None
    for expected_left in (4, 2, 0):
        shown, total, after = page(ENTRIES[:: -1 if newest_first else 1], 2, after, newest_first=newest_first)
        seen += "".join(entry.id for entry in shown)
        assert total == 6
        assert len(seen) == 6 - expected_left
    assert (seen, after) == (order, None)


def test_a_page_goes_on_where_its_entry_was_even_if_that_has_gone():
    _, _, after = page(ENTRIES[::-1], 3, None, newest_first=True)
    without = [entry for entry in ENTRIES[::-1] if entry.id != "d"]
    newer = [Made("g", "2026-01-09T00:00:00.000Z"), *without]
    assert "".join(entry.id for entry in page(newer, 9, after, newest_first=True)[0]) == "cba"


def test_what_was_made_after_the_clock_went_back_is_the_newest():
    entries, after, seen = [Made("z", "2025-01-01T00:00:00.000Z"), *ENTRIES[::-1]], None, ""
    for _ in range(3):
        shown, _, after = page(entries, 3, after, newest_first=True)
        seen += "".join(entry.id for entry in shown)
    assert (seen, after) == ("zfedcba", None)


@pytest.mark.parametrize(("path", "key"), LISTS.items())
def test_every_list_says_how_many_there_are_and_is_bounded(service, path, key):
    answer = service.get(f"/api/{path}", params={"limit": 500}).json()
    assert answer["total"] == len(answer[key])
    assert answer["next"] is None
    for limit in (0, 501):
        assert (
            is_problem(service.get(f"/api/{path}", params={"limit": limit}), 422)["errors"][0]["parameter"] == "limit"
        )


@pytest.mark.slow
@pytest.mark.parametrize(("path", "key"), LISTS.items())
def test_pages_of_a_service_put_together_are_its_list(service, scene, path, key):
    for _ in range(2):
        service.post("/api/goals", json={"random": {"moved": 1}, "scene": scene["id"]})
    busy = keep_busy(service)
    asked = [service.post("/api/estimates", json={"scene": scene["id"]}).json()["id"] for _ in range(3)]
    whole = [entry["id"] for entry in service.get(f"/api/{path}", params={"limit": 500}).json()[key]]
    seen, after = [], {}
    while after is not None:
        answer = service.get(f"/api/{path}", params={"limit": 2, **after}).json()
        assert answer["total"] == len(whole)
        seen += [entry["id"] for entry in answer[key]]
        after = None if answer["next"] is None else {"after": answer["next"]}
    assert seen == whole
    for job in (*asked, busy):
        service.delete(f"/api/jobs/{job}")
    for goal in service.get("/api/goals").json()["goals"]:
        service.delete(f"/api/goals/{goal['id']}")
