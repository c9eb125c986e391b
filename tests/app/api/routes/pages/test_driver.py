import pytest

from tests.app.api.routes.test_events import Stream
from tests.app.api.test_problems import is_problem
from tests.app.conftest import until


def test_pages_come_take_over_and_go(live):
    assert live.request("GET", "/api/driver")[1] == {"driver": None, "visitors": 0}
    with Stream(live, "?visitor=one") as one:
        assert one.next("driver")[2] == {"driver": "one", "visitors": 1}
        with Stream(live, "?visitor=two") as two:
            assert one.next("driver")[2] == {"driver": "one", "visitors": 2}
            assert two.next("driver")[2] == {"driver": "one", "visitors": 2}
            assert live.request("POST", "/api/driver", {"visitor": "two"}) == (200, {"driver": "two", "visitors": 2})
            assert one.next("driver")[2] == two.next("driver")[2] == {"driver": "two", "visitors": 2}
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


@pytest.mark.parametrize("visitor", ["", "a b", "x" * 65, "<b>", "é", None, 5])
def test_odd_names_of_pages_are_refused(service, visitor):
    is_problem(service.post("/api/driver", json={"visitor": visitor}), 422)
    if isinstance(visitor, str):
        is_problem(service.get("/api/events", params={"visitor": visitor}), 422)
    is_problem(service.post("/api/driver", json={}), 422)
    assert service.get("/api/driver").json()["visitors"] == 0
