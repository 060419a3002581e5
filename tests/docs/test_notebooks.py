"""The example notebooks run, without warnings, to the output that is stored in them."""

from __future__ import annotations

import json
import re

import pytest

from tests.docs.blocks import NOTEBOOKS, ROOT

NUMBER = re.compile(r"[-+]?\d[\d,]*\.?\d*(?:e[-+]?\d+)?")


def outputs(notebook) -> list[str]:
    """What was printed, cell by cell."""
    return [
        "".join(
            o["text"] if o["output_type"] == "stream" else o["data"].get("text/plain", "")
            for o in cell["outputs"]
            if o["output_type"] != "display_data"
        )
        for cell in notebook["cells"]
        if cell["cell_type"] == "code"
    ]


@pytest.mark.parametrize("path", NOTEBOOKS, ids=lambda p: p.stem)
def test_it_is_small_and_was_run_from_top_to_bottom(path):
    assert len(NOTEBOOKS) >= 4
    assert path.stat().st_size < 250_000
    notebook = json.loads(path.read_text())
    code = [c for c in notebook["cells"] if c["cell_type"] == "code"]
    assert [c["execution_count"] for c in code] == list(range(1, len(code) + 1))
    kinds = {k for c in code for o in c["outputs"] for k in o.get("data", {})}
    assert "image/png" in kinds
    assert not [o for c in code for o in c["outputs"] if o.get("name") == "stderr"]


@pytest.mark.slow
@pytest.mark.filterwarnings("ignore::DeprecationWarning")  # of the kernel's own machinery
@pytest.mark.parametrize("path", NOTEBOOKS, ids=lambda p: p.stem)
def test_it_runs_to_what_is_stored(path, tmp_path, monkeypatch):
    monkeypatch.setenv("PYTHONPATH", str(ROOT))
    monkeypatch.setenv("OPENBLAS_NUM_THREADS", "1")
    import nbformat  # half a second, in every process that collects this file
    from nbclient import NotebookClient

    before = nbformat.read(path, as_version=4)
    notebook = nbformat.read(path, as_version=4)
    client = NotebookClient(notebook, timeout=600, kernel_name="python3")
    client.resources = {"metadata": {"path": str(tmp_path)}}
    client.execute()
    for cell in notebook.cells:
        for output in cell.get("outputs", ()):
            assert output.get("name") != "stderr", output["text"]
    for now, then in zip(outputs(notebook), outputs(before), strict=True):
        assert NUMBER.sub("#", now) == NUMBER.sub("#", then)
        # p-values far below any level hang on the last digits of a correlation
        found, stored = (
            [float(n.replace(",", "")) for n in NUMBER.findall(text)] for text in (now, then)
        )
        assert found == pytest.approx(stored, rel=0.1, abs=0.02)
