"""The driver and its stand-in against picamera2's published signatures: no Pi is here to ask."""

from __future__ import annotations

import ast
import inspect
import json
from pathlib import Path

import pytest

from tests.drivers.fakes import picamera2_stand_in

ROOT = Path(__file__).resolve().parents[2]
API = json.loads(Path(__file__).with_name("picamera2_api.json").read_text())["classes"]
DRIVER = ast.parse((ROOT / "drivers/thermocald_drivers/picamera.py").read_text())
OBJECTS = {"camera": "Picamera2", "request": "CompletedRequest"}


def signature(kind: str, name: str) -> inspect.Signature:
    """A published method's, as Python builds it from the recorded text."""
    space: dict = {}
    exec(f"def published({API[kind][name]}): ...", space)
    return inspect.signature(space["published"])


def test_the_driver_uses_what_picamera2_has():
    """Every attribute of a camera or a request, and its call's arguments if it is called."""
    nodes = [*ast.walk(DRIVER)]
    calls = {id(n.func): n for n in nodes if isinstance(n, ast.Call)}
    used = [
        (OBJECTS[n.value.id], n.attr, calls.get(id(n)))
        for n in nodes
        if isinstance(n, ast.Attribute) and getattr(n.value, "id", None) in OBJECTS
    ]
    assert {"configure", "capture_request", "sensor_resolution"} <= {name for _, name, _ in used}
    for kind, name, call in used:
        assert name in API[kind], f"{kind} has no {name}"
        if call is not None:
            keywords = {keyword.arg: None for keyword in call.keywords}
            signature(kind, name).bind(*[None for _ in call.args], **keywords)


@pytest.mark.parametrize(
    ("kind", "stand_in"),
    [("Picamera2", picamera2_stand_in.StandIn), ("CompletedRequest", picamera2_stand_in.Request)],
)
def test_the_stand_in_has_no_method_that_picamera2_lacks(kind, stand_in):
    for name, method in vars(stand_in).items():
        if not name.startswith("_") and inspect.isfunction(method):
            own = [p for p in inspect.signature(method).parameters if p != "self"]
            assert set(own) <= set(signature(kind, name).parameters), name
