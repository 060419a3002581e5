"""The README's two pictures: a drift before and after correction, and the page of a study.

make pictures
"""

from __future__ import annotations

import sys
import tempfile
from pathlib import Path

import thermocald as tc
from thermocald.figures import BAND, Curve, Figure, Panel, draw_figure

HERE = Path(__file__).resolve().parents[1] / "pictures"
LAG = {"thermal_lag": {"tau": 75}}


def draw_drift(first: tc.Series, second: tc.Series, to: Path) -> None:
    """Draw x0 of a series, before and after correction with the model of another series."""
    found = tc.discover(first, verify=[second])
    camera = tc.fit(first, model=found.model)
    epochs = second.calibrate()
    minutes = (epochs.frame_time - epochs.frame_time[0]) / 60
    model = camera.along(epochs.frame_time, epochs.temperature).values[:, 1]
    pitch = second.head.camera.sensor.pixel_pitch
    panels = []
    for title, left in (("before", epochs.x0), ("after correction", epochs.x0 - model)):
        y, half = (left - left[0]) / pitch, BAND * epochs.sd_x0 / pitch
        curve = Curve("", minutes, y, half=half)
        panels.append(Panel(f"x₀ {title}", "time in min", "Δx₀ in px", (curve,)))
    drawing = draw_figure(Figure("drift", "", "", tuple(panels), columns=2))
    drawing.savefig(to, dpi=110)


def photograph_page(page: Path, to: Path) -> None:
    """Save the top of a page, 1280 px wide, as a small picture of few colours."""
    from PIL import Image
    from playwright.sync_api import sync_playwright

    with sync_playwright() as play:
        browser = play.chromium.launch(executable_path="/usr/bin/chromium", args=["--no-sandbox"])
        view = browser.new_page(viewport={"width": 1280, "height": 1120})
        view.goto(page.as_uri())
        view.screenshot(path=to)
        browser.close()
    picture = Image.open(to).convert("RGB")
    small = picture.resize((800, 700), Image.Resampling.LANCZOS)
    small.quantize(256).save(to, optimize=True)


def main() -> int:
    """Make both pictures, always from the same seeds."""
    HERE.mkdir(exist_ok=True)
    series = [tc.simulate("rpi-v2.1-heating", effects=LAG, seed=k, series=f"M{k}") for k in (1, 2)]
    draw_drift(*series, HERE / "drift.png")
    with tempfile.TemporaryDirectory() as folder:
        page = tc.study(*series, sets=20_000).report(Path(folder) / "study.html", "My camera")
        photograph_page(page, HERE / "study.png")
    total = sum(path.stat().st_size for path in HERE.glob("*.png"))
    sys.stdout.write(f"{HERE}: {total / 1000:.0f} kB\n")
    return 0 if total < 300_000 else 1


if __name__ == "__main__":
    sys.exit(main())
