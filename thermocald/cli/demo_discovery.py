"""The demo's last act: a camera follows its thermometer late, its model does not know it."""

from __future__ import annotations

from dataclasses import replace
from typing import TYPE_CHECKING, Any

import typer

from thermocald.atomic_file import make_folder
from thermocald.cli.common import say

if TYPE_CHECKING:
    from pathlib import Path

__all__ = ["discover_hidden_effect"]

_TAU_S = 75.0


def discover_hidden_effect(out: Path, seed: int, quiet: bool) -> dict[str, Any]:
    """Simulate M1 and M2 with a hidden lag, discover it on M1, prove it on M2; the document."""
    from thermocald.discovery.evidence.pair import load_together
    from thermocald.discovery.verdict.model import model_of
    from thermocald.discovery.verdict.result import discover_series
    from thermocald.reduction.reduce import reduce_together
    from thermocald.simulation import effects
    from thermocald.simulation.model import ModelEffect
    from thermocald.simulation.model_file import write_model
    from thermocald.simulation.presets import preset_simulation

    lag = effects.find(lambda e: any(p.role == "time_constant" for p in e.nonlinear.values())
                       and e.is_drive)  # fmt: skip
    say(f"hiding an effect: the camera follows the thermometer with a lag of {_TAU_S:.0f} s")
    folder = out / "discovery"
    make_folder(folder)
    for number, name in enumerate(("M1", "M2")):
        simulation = preset_simulation("rpi-v2.1-heating", seed + number, name, None)
        hidden = (ModelEffect(lag.name, {lag.delay: _TAU_S}),)
        model = replace(simulation.model, effects=hidden)
        replace(simulation, model=model).write(folder / name)
    say("discovering: where do model and measurement disagree, and why?")
    inputs = load_together(folder / "M1", [folder / "M2"], say)
    found = discover_series(reduce_together(inputs, None), say, ())
    path = folder / "camera.thermal.yaml"
    write_model(path, model_of(found, None))
    document: dict[str, Any] = dict(found.as_json(str(path)))
    document["hidden"] = {"effect": lag.name, "tau_s": _TAU_S}
    if not quiet:
        _tell(document)
    return document


def _tell(document: dict[str, Any]) -> None:
    hidden = document["hidden"]
    typer.echo(f"\nhidden:    {hidden['effect']}, tau {hidden['tau_s']:.0f} s")
    for effect in document["effects"]:
        typer.echo(f"found:     {effect['effect']}: {effect['statement']}")
    for label, key in (("on M1", "fit"), ("on M2", "verify")):
        gap = document["gap"][key]
        if gap is not None:
            typer.echo(
                f"gap {label}: {gap['before']['rms_px']:.3f} → {gap['after']['rms_px']:.3f} px, "
                f"reduced χ² {gap['before']['chi2_reduced']:.2f} → "
                f"{gap['after']['chi2_reduced']:.2f}"
            )
    typer.echo(f"model:     {document['model']}")
