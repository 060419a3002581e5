"""Run or update the goldens: `python -m tests.golden [--update] [--corpora] [NAME…]`.

`--update` stores the present results as expected ones. Read the diff before you commit it, and
explain in the commit why each number changed.
"""

from __future__ import annotations

import argparse
import os
import sys
import tempfile
import time
from pathlib import Path

os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")

from tests.golden.cases import CASES
from tests.golden.corpora import CORPORA, check
from tests.golden.workshop import DATA, Workshop, store, wrong


def main() -> int:
    options = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    options.add_argument("--update", action="store_true")
    options.add_argument("--corpora", action="store_true", help="the longer corpora of discovery")
    options.add_argument("names", nargs="*")
    given = options.parse_args()
    if given.corpora:
        return _corpora(given.update)
    known = {case.name for case in CASES}
    if unknown := set(given.names) - known:
        options.error(f"no such golden: {', '.join(sorted(unknown))}")
    failed = 0
    with tempfile.TemporaryDirectory() as folder:
        workshop = Workshop(Path(folder))
        for case in CASES:
            if given.names and case.name not in given.names:
                continue
            if case.needs_data and not DATA.is_dir():
                print(f"skipped  {case.name}: the reference data are absent")
                continue
            begin = time.process_time()
            found = workshop.result(case.name)
            seconds = time.process_time() - begin
            different = wrong(case, found)
            if given.update and different:
                store(case, found)
            word = "unchanged" if not different else "updated  " if given.update else "DIFFERENT"
            print(f"{word}  {case.name} ({seconds:.1f} s)")
            for line in different[:20]:
                print(f"    {line}")
            failed += bool(different) and not given.update
    return int(failed > 0)


def _corpora(update: bool) -> int:
    failed = 0
    for name in CORPORA:
        different, _ = check(name, update)
        failed += len(different)
        print(f"{name}: {len(different)} differences")
        for line in different:
            print(f"    {line}")
    return int(failed > 0 and not update)


if __name__ == "__main__":
    sys.exit(main())
