"""The notebook runs as it stands, and shows something."""

from pathlib import Path

import nbformat
import pytest
from nbclient import NotebookClient

NOTEBOOK = Path(__file__).parents[1] / "examples" / "notebook.ipynb"


@pytest.fixture(scope="module")
def executed():
    """The notebook with its outputs."""
    notebook = nbformat.read(NOTEBOOK, as_version=4)
    NotebookClient(notebook, timeout=600, resources={"metadata": {"path": str(NOTEBOOK.parent)}}).execute()
    return notebook


@pytest.mark.slow
def test_the_notebook_estimates_predicts_plans_and_shows(executed):
    outputs = [output for cell in executed.cells if cell.cell_type == "code" for output in cell.outputs]
    text = "".join(output.text for output in outputs if output.output_type == "stream")
    data = [output.data for output in outputs if output.output_type == "display_data"]
    assert "light: 0." in text
    assert "past everything: 005_tomato_soup_can 0 mm" in text
    left = text.partition("after each action:")[2].strip(" []\n").split()
    assert int(left[-1]) < 0.2 * int(left[0])
    assert any("image/png" in one for one in data)
    assert any("<iframe" in one.get("text/html", "") for one in data)


def test_no_outputs_are_kept_in_it():
    assert not any(cell.get("outputs") for cell in nbformat.read(NOTEBOOK, as_version=4).cells)
