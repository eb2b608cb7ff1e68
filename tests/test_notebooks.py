"""Every notebook runs from top to bottom, is stored with its outputs, and says the same as the text it is paired with."""

import re
import shutil
from pathlib import Path

import jupytext
import pytest
from nbclient.client import NotebookClient
from nbmake.nb_run import NotebookRun

FOLDER = Path(__file__).parent.parent / "notebooks"
NOTEBOOKS = sorted(FOLDER.glob("*.ipynb"))
TIMEOUT = 300
"""s for a cell, and for a kernel to start; nbclient's 60 s for that are too few beside other trainings"""
LARGEST = 1_500_000
"""bytes of a stored notebook"""


def name(path):
    return path.stem


def test_every_notebook_has_a_text():
    assert NOTEBOOKS and [path.stem for path in NOTEBOOKS] == sorted(path.stem for path in FOLDER.glob("*.py"))


def test_the_list_of_notebooks_is_complete():
    listed = re.findall(r"\((\d\d_\w+)\.ipynb\)", (FOLDER / "README.md").read_text())
    assert listed == sorted(path.stem for path in FOLDER.glob("*.py"))


@pytest.mark.parametrize("path", NOTEBOOKS, ids=name)
def test_pairs_say_the_same_and_outputs_are_stored(path):
    stored, text = jupytext.read(path), jupytext.read(path.with_suffix(".py"))
    assert [(cell.cell_type, cell.source) for cell in stored.cells] == [
        (cell.cell_type, cell.source) for cell in text.cells
    ], "run `make notebooks`"
    code = [cell for cell in stored.cells if cell.cell_type == "code"]
    assert [cell.execution_count for cell in code] == list(range(1, len(code) + 1))
    outputs = [output for cell in code for output in cell.outputs]
    assert not [output for output in outputs if output.output_type == "error"]
    assert any("image/png" in output.get("data", {}) for output in outputs)
    assert path.stat().st_size < LARGEST


@pytest.mark.parametrize("path", NOTEBOOKS, ids=name)
def test_notebooks_run_in_fast_mode(path, tmp_path, monkeypatch):
    """A copy is run, with everything shortened and nothing learned: no cell may fail."""
    monkeypatch.setenv("SB3_USPL_FAST_NOTEBOOKS", "1")
    monkeypatch.setenv("OMP_NUM_THREADS", "1")
    monkeypatch.setattr(NotebookClient, "startup_timeout", TIMEOUT)
    copy = tmp_path / path.name
    shutil.copy(path, copy)
    result = NotebookRun(copy, TIMEOUT).execute()
    assert result.error is None, result.error.summary if result.error else None


@pytest.mark.parametrize("path", NOTEBOOKS, ids=name)
def test_a_notebook_that_cannot_run_says_why_in_its_first_cell(path, monkeypatch):
    first = next(cell for cell in jupytext.read(path).cells if cell.cell_type == "code")
    monkeypatch.setattr("importlib.util.find_spec", lambda name: None)
    with pytest.raises(SystemExit, match="pip install"):
        exec(compile(first.source, str(path), "exec"), {})
