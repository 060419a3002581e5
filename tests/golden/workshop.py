"""The folder in which the golden commands run, and their results."""

from __future__ import annotations

import functools
import json
import os
from collections.abc import Callable
from pathlib import Path
from typing import Any
from unittest import mock

import numpy as np

from tests.commands import call
from tests.golden.cases import CASES, Case
from tests.golden.compare import differences, parsed, shortened
from tests.pictures import FOCAL, TAKEN, save_photograph
from tests.recordings import read_rows

EXPECTED = Path(__file__).parent / "expected"
DATA = Path(__file__).resolve().parents[3] / "shared" / "data"
_LINES = 60
_BY_NAME = {case.name: case for case in CASES}
_LAG = """format: thermocald-effect/1
effects: [{effect: thermal_lag, parameters: {tau: {value: 75.0, sd: 2.0, unit: s}}}]
"""
PROGRAMME = """format: thermocald-programme/1
name: warm-up
epochs: 90
interval: 20.0
ambient: 21.0
sources: {housing: [{from: 0, to: 1800, value: 3.0}]}
"""


class Workshop:
    """Runs each case once, after the cases that it needs."""

    def __init__(self, folder: Path) -> None:
        self.folder = folder
        self.found: dict[str, dict[str, Any]] = {}
        if DATA.is_dir():
            (folder / "data").symlink_to(DATA)
        write_inputs(folder)

    def result(self, name: str) -> dict[str, Any]:
        """Return exit status, printed lines and written files, as they are stored."""
        if name not in self.found:
            case = _BY_NAME[name]
            for earlier in case.after:
                self.result(earlier)
            if make := INPUTS.get(name):
                make(self.folder)
            self.found[name] = _run(case, self.folder)
        return self.found[name]

    def check(self, name: str, update: bool = False) -> tuple[list[str], Any]:
        """Return the differences from the stored result, and the result; `update` stores it.

        Numbers are stored with 14 digits.
        """
        found, path = self.result(name), EXPECTED / f"{name}.json"
        wrong = [f"{path.name} is missing: python -m tests.golden --update {name}"]
        if path.is_file():
            expected = json.loads(path.read_text())
            wrong = list(differences(expected, found, _BY_NAME[name].tolerance))
        if update and wrong:
            text = json.dumps(_rounded(found), separators=(",", ":"), ensure_ascii=False)
            # one entry per line, for readable diffs
            path.write_text(text.replace(',"', ',\n"').replace(":{", ":\n{") + "\n")
        return wrong, found


def _run(case: Case, folder: Path) -> dict[str, Any]:
    for name in case.writes:
        (folder / name).unlink(missing_ok=True)
    with mock.patch.dict(os.environ, COLUMNS="100"):
        done = call(*case.words, folder=folder)
    files = {n: parsed(n, (folder / n).read_text()) for n in case.writes if (folder / n).exists()}
    out: dict[str, Any] = {"status": done.returncode}
    if done.returncode:
        out["error"] = done.stderr.splitlines()[-1]
    if done.stdout.startswith("{"):
        out["document"] = json.loads(done.stdout)
    else:
        out["printed"] = done.stdout.splitlines()
    short = shortened(json.loads(json.dumps({**out, "files": files})))
    if "printed" in out and len(out["printed"]) <= _LINES:
        short["printed"] = out["printed"]
    return short


def _rounded(value: Any) -> Any:
    if isinstance(value, dict):
        return {k: _rounded(v) for k, v in value.items()}
    if isinstance(value, list):
        return [_rounded(v) for v in value]
    return float(f"{value:.13e}") if isinstance(value, float) else value


def write_inputs(folder: Path) -> None:
    """Write small files that commands read."""
    (folder / "lag.yaml").write_text(_LAG)
    (folder / "programme.yaml").write_text(PROGRAMME)
    camera = {
        "format": "thermocald-camera/1",
        "name": "pi",
        "sensor": {"width": 3280, "height": 2464, "pixel_pitch": 0.00112},
        "interior": {"c": 3.04, "x0": 0.01, "y0": -0.02, "A1": -2.5e-3, "A2": 1e-4, "B1": 1e-5},
    }
    (folder / "pi.json").write_text(json.dumps(camera))


def points(folder: Path) -> None:
    """Write image points at the times of M1's epochs."""
    rows = parsed("epochs.csv", (folder / "M1/epochs.csv").read_text())
    rng = np.random.default_rng(0)
    text = "time,x,y\n" + "".join(
        f"{t:.3f},{x:.3f},{y:.3f}\n"
        for t in rows["frame_time"][::3]
        for x, y in rng.uniform(100, 2300, (4, 2))
    )
    (folder / "points.csv").write_text(text)


def photographs(folder: Path) -> None:
    """Write six small photographs with EXIF times, and a German logger's file."""
    (folder / "photos").mkdir(exist_ok=True)
    for i in range(6):
        tags = {TAKEN: f"2026:06:14 12:00:{10 * i:02d}", FOCAL: 3.04}
        save_photograph(folder / "photos" / f"{i}.jpg", tags)
    rows = "".join(
        f"14.06.2026;12:0{i // 4}:{15 * (i % 4):02d};{21 + 0.25 * i:.2f}\n".replace("21.", "21,")
        .replace("22.", "22,") for i in range(8)
    )  # fmt: skip
    (folder / "log.csv").write_text("Datum;Uhrzeit;Temperatur °C\n" + rows, "latin-1")


def blind(
    folder: Path, name: str, effects: tuple[str, ...], strength: float, seed: int, epochs: int = 180
) -> None:
    """Write a blind recording with code that shares nothing with the program."""
    from tests.blind.case import Case as Blind
    from tests.blind.generator import generate, write

    for series in generate(Blind(effects, strength, seed, epochs=epochs))[0]:
        write(series, folder / name / series.name)


def real(folder: Path, camera: str, effect: str, seed: int) -> None:
    """Write recordings with an effect hidden in the corners of a real camera."""
    from tests.real_corners.generator import RealCase, generate, write

    for series in generate(RealCase(camera, (effect,) if effect else (), seed))[0]:
        write(series, camera, folder / "real" / series.name)


def walls(folder: Path) -> None:
    """Write the field of tags on the walls of a hall; corner 0 is bottom right."""
    corner = ("viewer_bottom_right", "viewer_bottom_left", "viewer_top_left", "viewer_top_right")
    rows = read_rows(DATA / "frc" / "targets.csv")
    lines = ["target,X,Y,Z,diameter,sX,sY,sZ,kind,code"]
    for row in rows:
        k, tag = corner.index(row["corner"]), row["tag_id"]
        place = ",".join(row[f"{axis}_mm"] for axis in "XYZ")
        lines.append(f"{tag}.{k},{place},,5,5,5,marker_corner,DICT_APRILTAG_36h11:{tag}:{k}")
    (folder / "walls.csv").write_text("\n".join(lines) + "\n")
    (folder / "lifecam.yaml").write_text(
        "name: lifecam\nwidth: 1280\nheight: 720\npixel_pitch: 0.001\n"
        "interior: {c: 1.1275, x0: -0.0139, y0: 0.0272}\n"
    )


INPUTS: dict[str, Callable[[Path], None]] = {
    "correct": points,
    "import": photographs,
    "data-calibrate": walls,
    "discover-lag": functools.partial(
        blind, name="lag", effects=("thermal_lag",), strength=0.2, seed=31, epochs=60
    ),
    "blind-time-offset": functools.partial(
        blind, name="time_offset", effects=("time_offset",), strength=0.1, seed=41
    ),
    "blind-pair": functools.partial(
        blind, name="pair", effects=("hysteresis", "decentering_drift"), strength=0.3, seed=50
    ),
    "real-lag": functools.partial(real, camera="aviary-cam6", effect="thermal_lag", seed=1),
}
