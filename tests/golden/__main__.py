"""Run or update the goldens: `python -m tests.golden [--update] [--corpora] [NAME…]`.

`--update` stores the present results as expected ones. Read the diff before you commit it, and
explain in the commit why each number changed.
"""

from __future__ import annotations

import argparse
import os
import sys
import tempfile
from pathlib import Path

os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")

from tests.golden import corpora
from tests.golden.cases import CASES
from tests.golden.workshop import DATA, Workshop


def main() -> int:
    options = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    options.add_argument("--update", action="store_true")
    options.add_argument("--corpora", action="store_true", help="the longer corpora of discovery")
    options.add_argument("names", nargs="*")
    given = options.parse_args()
    known = list(corpora.CORPORA) if given.corpora else [case.name for case in CASES]
    if unknown := set(given.names) - set(known):
        options.error(f"no such golden: {', '.join(sorted(unknown))}")
    without_data = {case.name for case in CASES if case.needs_data and not DATA.is_dir()}
    failed = False
    with tempfile.TemporaryDirectory() as folder:
        check = corpora.check if given.corpora else Workshop(Path(folder)).check
        for name in given.names or known:
            if name in without_data:
                print(f"skipped  {name}: the reference data are absent")
                continue
            different, _ = check(name, given.update)
            word = "unchanged" if not different else "updated  " if given.update else "DIFFERENT"
            print("\n    ".join([f"{word}  {name}", *different[:20]]))
            failed |= bool(different) and not given.update
    return int(failed)


if __name__ == "__main__":
    sys.exit(main())
