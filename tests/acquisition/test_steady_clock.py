"""Time stamps while the machine's UTC is stepped."""

from __future__ import annotations

from thermocald.acquisition.scheduler import Schedule
from thermocald.acquisition.steady_clock import SteadyClock
from thermocald.hal import VirtualClock


def test_an_hour_back_and_forth_never_turns_time_stamps_back():
    machine = VirtualClock(utc=1.7e9)
    clock = SteadyClock(machine)
    schedule = Schedule(clock, 10.0)
    stamps, steps = [], []
    for k in range(12):
        schedule.wait()
        stamps.append(clock.utc())
        if k == 3:
            machine.step_utc(-3600.0)
        if k == 7:
            machine.step_utc(3600.0)
        if (step := clock.check()) is not None:
            steps.append((step.seconds, step.adopted))
    assert stamps == [1.7e9 + 10.0 * k for k in range(12)]
    assert steps == [(-3600.0, False), (3600.0, False)]
    assert clock.error_s == 0.0


def test_a_pi_that_learns_the_time_after_boot_follows_forwards():
    machine = VirtualClock(utc=0.0)  # no battery: 1970
    clock = SteadyClock(machine)
    assert not clock.trusted()
    machine.step_utc(1.75e9)
    step = clock.check()
    assert step is not None
    assert step.adopted
    assert clock.utc() == 1.75e9
    assert clock.check() is None


def test_while_the_machine_was_set_back_its_time_is_not_trusted():
    machine = VirtualClock(utc=1.75e9)
    clock = SteadyClock(machine)
    machine.step_utc(-3600.0)
    clock.check()
    assert clock.error_s == -3600.0
    assert not clock.trusted()
