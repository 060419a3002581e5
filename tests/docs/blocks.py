"""The code blocks of the documentation, and the commands in them.

Convention: every block names its language. A `bash` block holds commands, one a line, run from
top to bottom of the page in one folder; `text` is output. Inline code that begins with `thermocald`
is a command too, and its name and options must exist.
"""

from __future__ import annotations

import json
import re
from dataclasses import dataclass
from pathlib import Path

ROOT = Path(__file__).parents[2]
LANGUAGES = {"bash", "csv", "ini", "json", "python", "sql", "text", "toml", "yaml"}
OTHERS = ("README.md", "CONTRIBUTING.md", "drivers/README.md")
PAGES = sorted([*(ROOT / "docs").rglob("*.md"), *(ROOT / other for other in OTHERS)])
NOTEBOOKS = sorted((ROOT / "examples").glob("*.ipynb"))


@dataclass(frozen=True)
class Block:
    """One fenced block; line: of its fence, from 1."""

    page: str
    line: int
    language: str
    text: str

    def commands(self) -> list[str]:
        """The command lines of a bash block, without comments, continued lines joined."""
        joined = re.sub(r"\\\n\s*", "", self.text)
        lines = (re.sub(r"(^|\s)#.*$", "", line).strip() for line in joined.splitlines())
        return [line for line in lines if line]


def name(page: Path) -> str:
    return str(page.relative_to(ROOT))


def blocks(page: Path) -> list[Block]:
    """The fenced blocks of a page, without the indentation of a list they stand in."""
    found, begun = [], None
    for number, line in enumerate(page.read_text(encoding="utf-8").splitlines(), 1):
        fence = re.fullmatch(r"( *)```(\S*)\s*", line)
        if begun is None:
            if fence:
                begun = (number, fence[1], fence[2], [])
        elif fence and not fence[2]:
            first, indent, language, lines = begun
            text = "\n".join(part.removeprefix(indent) for part in lines)
            found.append(Block(name(page), first, language, text + "\n"))
            begun = None
        else:
            begun[3].append(line)
    assert begun is None, f"{page}: the block of line {begun[0]} does not end"
    return found


def inline_commands(page: Path) -> list[str]:
    """Inline code of a page, or of a notebook's text, that begins with `thermocald` and a word."""
    text = page.read_text(encoding="utf-8")
    if page.suffix == ".ipynb":
        cells = json.loads(text)["cells"]
        text = "\n".join("".join(c["source"]) for c in cells if c["cell_type"] == "markdown")
    text = re.sub(r"^ *```.*?^ *```\s*$", "", text, flags=re.M | re.S)
    return re.findall(r"`(thermocald [a-z][^`]*)`", text)


def all_blocks(language: str | None = None) -> list[Block]:
    return [b for page in PAGES for b in blocks(page) if language in (None, b.language)]
