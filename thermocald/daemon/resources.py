"""What a camera line gets from the station that it belongs to, and nothing else of it."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any, Protocol

if TYPE_CHECKING:
    from collections.abc import Callable, Mapping, Sequence

    from thermocald.acquisition.frame_folder import FrameFolder
    from thermocald.acquisition.link import LinkEvent
    from thermocald.acquisition.pairing import Readings
    from thermocald.acquisition.steady_clock import SteadyClock
    from thermocald.daemon.epoch_keeper import EpochKeeper
    from thermocald.daemon.live_state import LiveState
    from thermocald.daemon.output_loop import OutputLoop
    from thermocald.daemon.plan import CameraPlan
    from thermocald.daemon.store_guard import StoreGuard

__all__ = ["Resources"]


class Resources(Protocol):
    """Clock, store, frames, readings and outputs, shared by the cameras of a station.

    fast, epochs, hang_after_s, start_condition: as of `Station`; preview: whether a page may look.
    """

    guard: StoreGuard
    clock: SteadyClock
    live: LiveState
    frames: FrameFolder
    readings: Readings
    outputs: list[OutputLoop]
    fast: bool
    epochs: int
    hang_after_s: float
    start_condition: str
    preview: bool

    def on_link_event(self, event: LinkEvent) -> None:
        """A device went away or came back."""

    def identity_of(self, line: Any) -> Callable[[], Mapping[str, Any]]:
        """What a camera and its thermometers say they are, asked when a series begins."""

    def make_observer(self, plan: CameraPlan, keeper: EpochKeeper) -> Any:
        """The online estimate of a camera; None if it is only acquired."""

    def read_now(self, names: Sequence[str]) -> None:
        """Read thermometers in the caller's thread."""
