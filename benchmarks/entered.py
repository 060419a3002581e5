"""Count the functions that a command enters, and the modules it imports.

    python -m benchmarks.entered [--list discover] [--check]

Counts with `sys.setprofile` the functions of thermocald and its drivers that `discover`, `replay`
and `run --recording` enter on one simulated recording, each in its own process: all functions with
comprehensions and lambdas (which the marks include), those of them that have a name, and all
imported modules. Methods that a dataclass generates do not count. --list prints the names by
module. With --check, the exit status is 1 if a command exceeds its mark (`MARKS`).
"""

from __future__ import annotations

import argparse
import collections
import inspect
import json
import os
import subprocess
import sys
import tempfile
import threading
from pathlib import Path
from types import CodeType, FrameType

os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")

ROOT = Path(__file__).parents[1]
PACKAGES = (str(ROOT / "thermocald"), str(ROOT / "drivers" / "thermocald_drivers"))
MARKS = {"discover": (400, 70), "replay": (300, 45), "run": (450, 60)}
"""Most functions and modules per command (a goal, not yet a bound)."""


def entered(*command: str) -> set[CodeType]:
    """Return thermocald's code that a command enters."""
    seen: set[CodeType] = set()

    def note(frame: FrameType, event: str, _: object) -> None:
        if event == "call":
            seen.add(frame.f_code)

    threading.setprofile(note)
    sys.setprofile(note)
    try:
        from tests.commands import call

        ended = call(*command)
    finally:
        sys.setprofile(None)
        threading.setprofile(None)
    if ended.returncode:
        raise SystemExit(f"{' '.join(command)}: {ended.stderr}")
    return {code for code in seen if code.co_filename.startswith(PACKAGES)}


def count(codes: set[CodeType]) -> dict[str, object]:
    """Return the numbers of functions, of named ones and of modules, and the names by module."""
    functions = [c for c in codes if c.co_name != "<module>" and c.co_flags & inspect.CO_OPTIMIZED]
    names = collections.defaultdict(list)
    for code in functions:
        if not code.co_name.startswith("<"):
            names[str(Path(code.co_filename).relative_to(ROOT))].append(code.co_qualname)
    return {
        "functions": len(functions),
        "named": sum(map(len, names.values())),
        "modules": len({c.co_filename for c in codes}),
        "names": {module: sorted(own) for module, own in sorted(names.items())},
    }


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--list", choices=list(MARKS))
    parser.add_argument("--check", action="store_true")
    parser.add_argument("--of", nargs=argparse.REMAINDER, help=argparse.SUPPRESS)
    a = parser.parse_args()
    if a.of:
        print(json.dumps(count(entered(*a.of))))
        return
    missed = []
    with tempfile.TemporaryDirectory() as folder:
        m1 = f"{folder}/M1"
        run("thermocald", "simulate", "--preset", "rpi-v2.1-heating", "--seed", "1", "--out", m1)
        commands = {
            "discover": ("discover", m1),
            "replay": ("replay", m1),
            "run": ("run", "--recording", m1, "--fast", "--store", f"{folder}/run.db"),
        }
        for name, command in commands.items():
            if a.list not in (None, name):
                continue
            found = json.loads(run("benchmarks.entered", "--of", *command).splitlines()[-1])
            most, widest = MARKS[name]
            print(
                f"{name}: {found['functions']} functions ({found['named']} named) in "
                f"{found['modules']} modules; mark: {most} functions in {widest} modules"
            )
            if a.list:
                for module, names in found["names"].items():
                    print(f"  {module}: {', '.join(names)}")
            if found["functions"] > most or found["modules"] > widest:
                missed.append(name)
    if a.check and missed:
        raise SystemExit(f"above the mark: {', '.join(missed)}")


def run(module: str, *arguments: str) -> str:
    """Run a module; return what it prints."""
    command = [sys.executable, "-m", module, *arguments]
    ended = subprocess.run(command, cwd=ROOT, capture_output=True, text=True, check=False)
    if ended.returncode:
        raise SystemExit(ended.stderr)
    return ended.stdout


if __name__ == "__main__":
    main()
