"""The page of code: a tick, a series, a discovery, an effect and a driver, as they are today."""

from __future__ import annotations

import inspect
import pkgutil
import textwrap
from pathlib import Path

__all__ = ["PAGES", "page"]

REPOSITORY = Path(__file__).resolve().parents[2]
PAGES = {
    "A tick": (
        (
            "A camera's thread hands a frame over; the readings next to it are paired, it is "
            "measured and adjusted, and kept in the order of the frames."
        ),
        "thermocald.acquisition.pipeline:Pipeline.submit",
        "thermocald.acquisition.pipeline:calibrate_frame",
    ),
    "A series": (
        "All epochs are adjusted together; first the data decide how the camera moved.",
        "thermocald.photogrammetry.series.adjustment:adjust_series",
        "thermocald.photogrammetry.series.adjustment:adjusted",
    ),
    "A discovery": (
        (
            "Targets that moved and the measuring noise come first, then the search: effects are "
            "added while they are worth their penalty, and removed when they no longer are."
        ),
        "thermocald.discovery.examination:examine_series",
        "thermocald.discovery.search:Search.expand",
        "thermocald.discovery.search:Search.shrink",
    ),
    "An effect": (
        (
            "One class, used forward in the simulation, as columns of a fit, and as words in a "
            "report. Everything in which effects differ is stated here."
        ),
        "thermocald.physics.effects.heat:ThermalLag",
    ),
    "A driver": (
        (
            "One class for one contract of the HAL. It gives what the hardware said, when it said "
            "it, or an error that says whether trying again can help."
        ),
        "thermocald_drivers.i2c:Tmp117Thermometer",
    ),
}
"""Title: a sentence, and what is shown."""


def page() -> str:
    """Title, sentence and source of each of PAGES."""
    parts = []
    for title, (sentence, *names) in PAGES.items():
        parts += [f"## {title}", sentence]
        for name in names:
            found = pkgutil.resolve_name(name)
            file = Path(inspect.getsourcefile(found) or "").resolve().relative_to(REPOSITORY)
            code = textwrap.dedent(inspect.getsource(found)).rstrip()
            parts += [f"`{file.as_posix()}`", f"```python\n{code}\n```"]
    return "\n\n".join(parts)
