"""The demo's last act: a camera follows its thermometer late, its model does not know it."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import typer

from thermocald.cli.common import say
from thermocald.files import make_folder

if TYPE_CHECKING:
    from pathlib import Path

__all__ = ["discover_hidden_effect"]

_HIDDEN = "thermal_lag"
_TAU_S = 75.0


def discover_hidden_effect(out: Path, seed: int, quiet: bool) -> dict[str, Any]:
    """Simulate M1 and M2 with a hidden lag, discover it on M1, prove it on M2; the document."""
    import thermocald as tc

    say(f"hiding an effect: the camera follows the thermometer with a lag of {_TAU_S:.0f} s")
    folder = out / "discovery"
    make_folder(folder)
    M1, M2 = (
        tc.simulate(
            "rpi-v2.1-heating", effects={_HIDDEN: {"tau": _TAU_S}}, own_effects=False,
            seed=seed + number, series=name, out=folder / name,
        )
        for number, name in enumerate(("M1", "M2"))
    )  # fmt: skip
    say("discovering: where do model and measurement disagree, and why?")
    found = tc.discover(M1, verify=[M2], say=say)
    document = found.as_dict()
    document["model"] = str(found.save(folder / "camera.thermal.yaml"))
    document["hidden"] = {"effect": _HIDDEN, "tau_s": _TAU_S}
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
