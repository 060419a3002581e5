"""Manual pages and completions say what the commands say."""

from __future__ import annotations

import os
import subprocess
import sys
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parents[2]


@pytest.fixture(scope="module")
def manual(tmp_path_factory) -> Path:
    folder = tmp_path_factory.mktemp("manual")
    subprocess.run(
        [sys.executable, ROOT / "packaging/manual.py", folder],
        check=True, env={**os.environ, "SOURCE_DATE_EPOCH": "86400"},
    )  # fmt: skip
    return folder


def complete(manual: Path, *words: str) -> list[str]:
    """What bash offers after these words; the last one is being typed."""
    script = (
        f"source {manual}/bash/thermocald; COMP_WORDS=({' '.join(words)} ''); "
        f'COMP_CWORD={len(words) - 1}; _thermocald; printf "%s\\n" "${{COMPREPLY[@]}}"'
    )
    done = subprocess.run(["bash", "-c", script], capture_output=True, text=True, check=True)
    return done.stdout.split()


def test_every_command_has_a_page_and_is_completed_by_fish_and_zsh(manual):
    pages = {page.stem: page.read_text() for page in (manual / "man1").iterdir()}
    assert {"thermocald", "thermocald-study", "thermocald-testfield-print"} <= set(pages)
    fish = (manual / "fish/thermocald.fish").read_text()
    zsh = (manual / "zsh/_thermocald").read_text()
    for stem, text in pages.items():
        name, _, line = text.splitlines()[2].partition(r" \- ")
        assert name.replace("\\", "") == stem
        assert line, f"{stem} has no line that says what it does"
        assert "\n'" not in text
        word = stem.split("-")[-1]
        assert stem == "thermocald" or (f"-a {word} " in fish and f"{word}:" in zsh)
    text = pages["thermocald-testfield-print"]
    assert '.TH THERMOCALD-TESTFIELD-PRINT 1 "1970-01-02"' in text
    assert r"\-\-paper" in text


def test_bash_completes_commands_groups_and_options(manual):
    assert "testfield" in complete(manual, "thermocald", "testf")
    assert complete(manual, "thermocald", "testfield", "pri") == ["print"]
    assert complete(manual, "thermocald", "testfield", "print", "--pap") == ["--paper"]
    assert "--paper" not in complete(manual, "thermocald", "study", "--p")
