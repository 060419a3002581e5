"""A script; unplugging takes it away."""

from __future__ import annotations

from contextlib import contextmanager

from tests.drivers.laboratory.bench import Bench


@contextmanager
def output(tmp_path, monkeypatch):
    script, away = tmp_path / "hook", tmp_path / "away"
    script.write_text("#!/bin/sh\ncat > /dev/null\n")
    script.chmod(0o755)
    yield Bench(
        {"command": [str(script)], "when": [{"no_result": 2}], "timeout_s": 5},
        unplug=lambda: script.rename(away),
        plug=lambda: away.rename(script),
    )
