"""A phone behind an adb server on loopback."""

from __future__ import annotations

from tests.drivers.laboratory.android import _phone


def output(tmp_path, monkeypatch):
    programme = [{"seconds": 1000, "hold_c": 38.0}]
    return _phone(tmp_path, monkeypatch, limit_c=42, programme=programme)
