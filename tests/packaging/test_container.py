"""The container's files, read: there need not be an engine here that could build them."""

from __future__ import annotations

import re
from pathlib import Path

import yaml

ROOT = Path(__file__).resolve().parents[2]
LINES = re.sub(r"\\\n\s*", " ", (ROOT / "Dockerfile").read_text()).splitlines()


def instructions(kind: str) -> list[str]:
    return [line.split(" ", 1)[1] for line in LINES if line.startswith(f"{kind} ")]


def test_everything_that_is_copied_exists():
    copied = [words.split() for words in instructions("COPY") if "--from=" not in words]
    assert copied
    assert [s for words in copied for s in words[:-1] if not (ROOT / s).exists()] == []


def test_what_is_installed_is_locked_and_nothing_runs_as_root_or_writes_beside_its_volume():
    assert any("--require-hashes" in words for words in instructions("RUN"))
    last = max(i for i, line in enumerate(LINES) if line.startswith("RUN "))
    assert last < LINES.index("USER thermocald")
    assert instructions("USER") == ["thermocald"]
    assert instructions("HEALTHCHECK")
    service = yaml.safe_load((ROOT / "compose.yaml").read_text())["services"]["thermocald"]
    assert (service["read_only"], service["cap_drop"]) == (True, ["ALL"])
    assert any(volume.endswith(":/var/lib/thermocald") for volume in service["volumes"])
    assert instructions("VOLUME") == ["/var/lib/thermocald"]
