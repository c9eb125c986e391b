import pytest

from app.processes.process_client import ProcessUnavailable
from app.services.objects.thumbnails import Thumbnails


def test_stopped_it_begins_no_process_for_those_who_still_wait(library, tmp_path):
    thumbnails = Thumbnails(library, tmp_path / "thumbnails")
    thumbnails.stop()
    with pytest.raises(ProcessUnavailable):
        thumbnails.png("003_cracker_box")
    thumbnails.stop()  # again: nothing happens
