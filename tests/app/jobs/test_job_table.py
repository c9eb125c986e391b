import pytest

from app.jobs.job import Job, JobForgotten, ended
from app.jobs.table import JobTable
from app.storage.database import CannotStore, Store
from osfcore.errors import UnknownName


@pytest.fixture
def store(tmp_path):
    store = Store(tmp_path)
    yield store
    store.close()


@pytest.fixture
def told():
    return []


@pytest.fixture
def table(store, told, tmp_path):
    """Ten jobs of two kinds in turn, of which the last three wait."""
    table = JobTable(store, tmp_path, told.append)
    for number in range(10):
        table.add(Job(f"j{number}", ("collect_table", "collect_pushes")[number % 2], {}))
    for number in range(7):
        table.set(ended(table[f"j{number}"], "done"))
    return table


def ids(page):
    return [job.id for job in page.jobs]


def test_pages_follow_each_other_whatever_comes_and_goes_meanwhile(table):
    first = table.page(4)
    assert (ids(first), first.total) == (["j9", "j8", "j7", "j6"], 10)
    table.add(Job("new", "collect_table", {}))
    table.forget(table["j6"])  # the very one after which the next page begins
    table.forget(table["j3"])
    second = table.page(4, first.next)
    assert (ids(second), second.total) == (["j5", "j4", "j2", "j1"], 9)
    last = table.page(4, second.next)
    assert (ids(last), last.next) == (["j0"], None)
    assert ids(table.page(4, 0)) == []


def test_pages_of_a_kind_count_only_that_kind(table):
    first = table.page(3, kind="collect_pushes")
    assert (ids(first), first.total) == (["j9", "j7", "j5"], 5)
    rest = table.page(3, first.next, "collect_pushes")
    assert (ids(rest), rest.next) == (["j3", "j1"], None)


def test_every_way_to_a_waiting_job_tells_its_place(table):
    assert [job.position for job in table.all()] == [None] * 7 + [1, 2, 3]
    assert [job.position for job in table.page(4).jobs] == [3, 2, 1, None]
    assert table.get("j8").position == 2


def test_a_job_of_another_kind_is_not_found(table):
    assert table.get("j8", "collect_table").id == "j8"
    with pytest.raises(UnknownName):
        table.get("j8", "collect_pushes")


def test_a_forgotten_job_is_gone_and_pages_that_come_back_are_told(table, store, told, tmp_path):
    before = told[-1].event
    table.forget(table["j2"])
    assert isinstance(told[-1], JobForgotten)
    assert (told[-1].event, told[-1].job.id) == (before + 1, "j2")
    assert "j2" not in [fields["id"] for _, fields in store.jobs()]
    assert store.events_after(before) == ((before + 1, {"forgotten": "j2"}),)
    assert "j2" not in [fields.get("id") for _, fields in store.events_after(0)]
    again = JobTable(store, tmp_path, told.append)
    again.load()
    assert [job.id for job in again.all()] == [job.id for job in table.all()]


def test_a_job_stays_where_the_disk_refuses(table, store):
    store.close()
    with pytest.raises(CannotStore):
        table.forget(table["j2"])
    assert table.get("j2").id == "j2"
