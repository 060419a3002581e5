"""Documentation and notebooks use only public names, and the Python code they show runs."""

from __future__ import annotations

import json
import re
import shutil
from pathlib import Path

ROOT = Path(__file__).resolve().parents[2]
DEEPER = re.compile(r"thermocald\.[a-z_]+\.[a-z]")
OF_DEVELOPERS = {"docs/reference/drivers.md", "docs/reference/effects.md"}
SHOWN = "how-to/thermal-model.md"
"""A quick one; all pages are run by tests/docs/test_commands.py."""


def test_nothing_deeper_is_imported():
    found = []
    examples = [p for p in ROOT.glob("examples/**/*") if p.suffix in (".ipynb", ".md", ".py")]
    for path in [*ROOT.glob("docs/**/*.md"), *examples, ROOT / "README.md"]:
        name = str(path.relative_to(ROOT))
        text = path.read_text()
        if path.suffix == ".ipynb":
            text = "\n".join("".join(cell["source"]) for cell in json.loads(text)["cells"])
        if name not in OF_DEVELOPERS:
            found += [f"{name}: {m}" for m in DEEPER.findall(text)]

    assert found == []


def test_what_a_page_shows_of_python_runs(inside, tmp_path, monkeypatch, recwarn):
    shutil.copy(inside / "camera.yaml", tmp_path / "camera.thermal.yaml")
    monkeypatch.chdir(tmp_path)
    blocks = re.findall(r"```python\n(.*?)```", (ROOT / "docs" / SHOWN).read_text(), re.DOTALL)

    assert blocks
    for block in blocks:
        exec(compile(block, SHOWN, "exec"), {"__name__": "page"})


def test_a_drift_is_drawn_in_ten_lines():
    text = (ROOT / "docs/how-to/notebook.md").read_text()
    first = re.findall(r"```python\n(.*?)```", text, re.DOTALL)[0]

    assert len([line for line in first.splitlines() if line.strip()]) <= 10
