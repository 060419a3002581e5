"""An effect from another package is simulated, discovered and documented."""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path

OUTSIDE = '''
"""Saturation: a spring that gives less and less."""

import numpy as np

from thermocald.physics.effect import Effect, Parameter, coefficient_units


class Saturation(Effect):
    """Adds a tanh((T - T_s) / 4 K)."""

    name = "saturation"
    noun = "a spring that saturates"
    kind = "signal"
    nonlinear = {"T_s": Parameter("degC", -40.0, 150.0, 40.0, role="threshold")}
    linear = coefficient_units("1")
    usual = ("c", "x0", "y0")
    behaviour = {"cycle": "runs along the same bent line up and down"}

    def signal(self, history, T_s=40.0, **_):
        return np.tanh((history.temperature() - T_s) / 4.0)[:, None]

    def sensitivity(self, history, T_s=40.0, **_):
        slope = 0.25 / np.cosh((history.temperature() - T_s) / 4.0) ** 2
        return history.temperature_matrix().multiply(slope[:, None]).tocsr()
'''
PROGRAM = """
import os
os.environ["OPENBLAS_NUM_THREADS"] = "1"
from dataclasses import replace
from thermocald.discovery.result import discover_series
from thermocald.thermal.reduce import reduce_together
from thermocald.thermal.source import epochs_input
from thermocald.physics.heat import Course
from thermocald.physics.model import ModelEffect
from thermocald.physics.presets import preset_simulation

hidden = ModelEffect("saturation", {"T_s": 38.0, "c": 1e-3, "x0": 2e-3, "y0": -1e-3})
s = preset_simulation("rpi-v2.1-heating", seed=3)
lamp = Course.steps([0, 80.0, 700.0, 1e5], [0.0, 9.0, 0.0])
programme = replace(s.programme, epochs=60, interval=20.0, sources={"housing": lamp})
s = replace(s, model=replace(s.model, effects=(hidden,)), programme=programme)
source = epochs_input(s.head, s.field, list(s.epochs()), "M1")
(found,) = discover_series(reduce_together([source])).effects
for name, true in (("T_s", 38.0), ("a_x0", 2e-3)):
    said = found.estimates[name]
    assert abs(said["value"] - true) < 4 * said["sd"], said
print("discovered", found.effect)

from tests.commands import call
print(call("simulate", "--list").stdout)
import reference
print(reference._effect_page())
"""
ROOT = Path(__file__).parents[2]


def run_with(folder: Path, module: str, program: str) -> subprocess.CompletedProcess[str]:
    """Run a program beside a small distribution: one module, one entry point."""
    (folder / "saturation.py").write_text(module)
    info = folder / "saturation-1.0.dist-info"
    info.mkdir()
    (info / "METADATA").write_text("Metadata-Version: 2.1\nName: saturation\nVersion: 1.0\n")
    (info / "entry_points.txt").write_text(
        "[thermocald.effects]\nsaturation = saturation:Saturation\n"
    )
    path = f"{folder}:{ROOT}:{ROOT / 'tests/photogrammetry'}:{ROOT / 'docs/_site'}"
    return subprocess.run(
        [sys.executable, "-c", program], cwd=folder, capture_output=True, text=True, check=False,
        env={"PYTHONPATH": path, "PATH": "/usr/bin:/bin"},
    )  # fmt: skip


def test_an_effect_from_outside(tmp_path):
    ran = run_with(tmp_path, OUTSIDE, PROGRAM)
    assert ran.returncode == 0, ran.stderr
    found, listed = ran.stdout.split("\n", 1)
    assert found.split() == ["discovered", "saturation"]
    assert listed.count("saturation") > 1
    assert "Adds a tanh" in listed


def test_other_classes_than_effects_are_refused(tmp_path):
    program = "from thermocald.physics import catalogue; catalogue.get('saturation')"
    ran = run_with(tmp_path, "class Saturation:\n    pass\n", program)
    assert "ConfigurationError" in ran.stderr
    assert "saturation:Saturation, which is not an Effect" in ran.stderr
