"""The container's files, read: there need not be an engine here that could build them."""

from __future__ import annotations

import re
from pathlib import Path

import yaml

ROOT = Path(__file__).resolve().parents[2]
DOCKERFILE = (ROOT / "Dockerfile").read_text()
LINES = re.sub(r"\\\n\s*", " ", DOCKERFILE).splitlines()


def instructions(kind: str) -> list[str]:
    return [line.split(" ", 1)[1] for line in LINES if line.startswith(f"{kind} ")]


def test_everything_that_is_copied_exists():
    for words in instructions("COPY"):
        if "--from=" not in words:
            for source in words.split()[:-1]:
                assert (ROOT / source).exists(), source


def test_what_is_installed_is_locked_and_nothing_runs_as_root():
    assert any("--require-hashes" in words for words in instructions("RUN"))
    assert instructions("USER") == ["thermocald"]
    last = max(i for i, line in enumerate(LINES) if line.startswith("RUN "))
    assert last < LINES.index("USER thermocald")
    assert instructions("HEALTHCHECK")


def test_compose_is_read_only_and_has_a_volume_for_the_data():
    service = yaml.safe_load((ROOT / "compose.yaml").read_text())["services"]["thermocald"]
    assert service["read_only"] is True
    assert service["cap_drop"] == ["ALL"]
    assert any(volume.endswith(":/var/lib/thermocald") for volume in service["volumes"])
    assert instructions("VOLUME") == ["/var/lib/thermocald"]
