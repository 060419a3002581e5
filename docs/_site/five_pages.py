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
            "The daemon's tick without its threads: wait for the deadline, take a frame and the "
            "readings next to it, measure and adjust, hand over."
        ),
        "thermocald.acquisition.pipeline:Pipeline.run",
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
        "thermocald.discovery.search.examination:examine_series",
        "thermocald.discovery.search.search:Search.expand",
        "thermocald.discovery.search.search:Search.shrink",
    ),
    "An effect": (
        (
            "One class, used forward in the simulation, as columns of a fit, and as words in a "
            "report. Everything in which effects differ is stated here."
        ),
        "thermocald.simulation.effects.thermal_lag:ThermalLag",
    ),
    "A driver": (
        (
            "One class for one contract of the HAL. It gives what the hardware said, when it said "
            "it, or an error that says whether trying again can help."
        ),
        "thermocald_drivers.tmp117:Tmp117Thermometer",
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
