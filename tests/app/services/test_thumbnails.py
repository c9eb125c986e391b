import pytest

from app.processes.client import ProcessUnavailable
from app.services.objects import Thumbnails
from tests.app.conftest import full_disk


def test_stopped_it_begins_no_process_for_those_who_still_wait(library, tmp_path):
    thumbnails = Thumbnails(library, tmp_path / "thumbnails")
    thumbnails.stop()
    with pytest.raises(ProcessUnavailable):
        thumbnails.png("003_cracker_box")
    thumbnails.stop()  # again: nothing happens


@pytest.mark.slow
def test_on_a_full_disk_it_is_drawn_anew_each_time(library, tmp_path):
    thumbnails = Thumbnails(library, tmp_path / "thumbnails")
    try:
        with full_disk():
            drawn = thumbnails.png("003_cracker_box")
            assert thumbnails.png("003_cracker_box") == drawn
        assert not [path for path in tmp_path.rglob("*.png")]
        assert thumbnails.png("003_cracker_box") == drawn
        assert [path.read_bytes() for path in tmp_path.rglob("*.png")] == [drawn]
    finally:
        thumbnails.stop()
