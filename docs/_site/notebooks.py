"""The example notebooks as pages: their text, code and stored output."""

from __future__ import annotations

import base64
import json
from pathlib import Path
from typing import Any

__all__ = ["found", "pages"]

FOLDER = Path(__file__).resolve().parents[2] / "examples"
_PICTURES = {"image/png": "png"}


def found() -> list[Path]:
    """Return the notebooks, in the order of their names."""
    return sorted(FOLDER.glob("*.ipynb"))


def pages() -> dict[str, str | bytes]:
    """Return {address within the site: Markdown or picture} of all notebooks."""
    contents: dict[str, str | bytes] = {}
    for path in found():
        notebook = json.loads(path.read_text(encoding="utf-8"))
        parts: list[str] = []
        for cell in notebook["cells"]:
            source = "".join(cell["source"])
            if cell["cell_type"] == "markdown":
                parts.append(source)
                continue
            parts.append(f"```python\n{source}\n```")
            parts += [_shown(output, path.stem, contents) for output in _joined(cell["outputs"])]
        parts.insert(1, f"*This page is the notebook `examples/{path.name}` as it ran.*")
        contents[f"examples/{path.stem}.md"] = "\n\n".join(parts) + "\n"
    return contents


def _joined(outputs: list[dict[str, Any]]) -> list[dict[str, Any]]:
    """Join the pieces of printed output."""
    found: list[dict[str, Any]] = []
    for output in outputs:
        if found and output["output_type"] == found[-1]["output_type"] == "stream":
            found[-1] = {**found[-1], "text": [*found[-1]["text"], *output["text"]]}
        else:
            found.append(output)
    return found


def _shown(output: dict[str, Any], stem: str, contents: dict[str, str | bytes]) -> str:
    """Return one output as Markdown; its picture is added to `contents`."""
    if output["output_type"] == "stream":
        return f"```text\n{''.join(output['text']).rstrip()}\n```"
    data = output["data"]
    for kind, ending in _PICTURES.items():
        if kind in data:
            name = f"{stem}-{sum(k.startswith(f'examples/{stem}-') for k in contents) + 1}.{ending}"
            contents[f"examples/{name}"] = base64.b64decode("".join(data[kind]))
            return f"![Figure: {output['metadata'].get('alt', stem)}]({name})"
    return f"```text\n{''.join(data['text/plain'])}\n```"
