import logging
import warnings

import pytest

from app.processes.client import ProcessClient
from app.processes.server import InternalError


def grumbling_main(server):
    server.serve(_grumble)


def _grumble(command, _):
    logging.getLogger("osf.child").info("nobody wants to know")
    logging.getLogger("osf.child").warning("%s of a child", command)
    warnings.warn("of a library", RuntimeWarning, stacklevel=1)
    raise ZeroDivisionError("a defect")


def test_what_a_child_logs_is_logged_by_the_service(caplog):
    client = ProcessClient(grumbling_main, (), "grumbler")
    with pytest.raises(InternalError):
        client.call("words")
    client.stop()
    told = [(record.name, record.levelname, record.getMessage()) for record in caplog.records]
    assert told[0] == ("osf.child", "WARNING", "words of a child")
    assert told[1][:2] == ("py.warnings", "WARNING")
    assert "RuntimeWarning: of a library" in told[1][2]
    assert told[2][:2] == ("app.processes.server", "ERROR")
    assert "could not carry out str" in told[2][2]
    assert "ZeroDivisionError: a defect" in told[2][2]
    assert len(told) == 3
