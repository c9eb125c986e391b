import pytest

from tests.app.api.routes.test_events import Stream
from tests.app.api.test_problems import is_problem
from tests.app.conftest import until


@pytest.mark.slow
def test_pages_come_take_over_and_go(live):
    assert live.request("GET", "/api/driver")[1] == {"driver": None, "visitors": 0}
    with Stream(live, "?visitor=one") as one:
        assert one.next("driver")[2] == {"driver": "one", "visitors": 1}
        with Stream(live, "?visitor=two") as two:
            assert one.next("driver")[2] == {"driver": "one", "visitors": 2}
            assert two.next("driver")[2] == {"driver": "one", "visitors": 2}
            assert live.request("POST", "/api/driver", {"visitor": "two"}) == (200, {"driver": "two", "visitors": 2})
            assert one.next("driver")[2] == two.next("driver")[2] == {"driver": "two", "visitors": 2}
        # The wheel is kept for a moment: the page may only be loading again.
        assert one.next("driver")[2] == {"driver": "two", "visitors": 1}
        assert one.next("driver")[2] == {"driver": "one", "visitors": 1}
    until(lambda: live.request("GET", "/api/driver")[1] == {"driver": None, "visitors": 0})


def test_programs_do_not_count_and_are_never_refused(live):
    with Stream(live, "?visitor=one") as page, Stream(live) as program:
        page.next("driver")
        program.next("scene")
        assert live.request("GET", "/api/driver")[1] == {"driver": "one", "visitors": 1}
        status, scene = live.request("POST", "/api/scenes", {"count": 1, "seed": 1})
        assert status == 201
        live.request("DELETE", f"/api/scenes/{scene['id']}")
    until(lambda: live.request("GET", "/api/driver")[1]["visitors"] == 0)


def test_a_page_that_watches_can_look_at_everything_and_change_nothing(live):
    def request(method, path, body=None, visitor="two"):
        return live.request(method, path, body, headers={"X-OSF-Visitor": visitor})

    with Stream(live, "?visitor=one") as page:
        page.next("driver")
        assert request("GET", "/api/scenes")[0] == 200
        for method, path, body in (
            ("POST", "/api/scenes", {"count": 1}),
            ("POST", "/api/jobs", {"kind": "fetch_assets", "params": {}}),
            ("DELETE", "/api/goals/draft", None),
            ("POST", "/api/presets/first", None),
        ):
            status, problem = request(method, path, body)
            assert (status, problem["detail"]) == (409, "Someone else is driving; take over first.")
        assert request("PUT", "/api/views/two", {"replay": None})[0] == 200
        assert request("POST", "/api/driver", {"visitor": "two"})[0] == 200
        assert request("DELETE", "/api/goals/draft")[0] < 300
        assert request("DELETE", "/api/goals/draft", visitor="one")[0] == 409
    until(lambda: live.request("GET", "/api/driver")[1]["visitors"] == 0)


@pytest.mark.parametrize("visitor", ["", "a b", "x" * 65, "<b>", "é", None, 5])
def test_odd_names_of_pages_are_refused(service, visitor):
    is_problem(service.post("/api/driver", json={"visitor": visitor}), 422)
    if isinstance(visitor, str):
        is_problem(service.get("/api/events", params={"visitor": visitor}), 422)
    is_problem(service.post("/api/driver", json={}), 422)
    assert service.get("/api/driver").json()["visitors"] == 0
