"""Installation as by pipx: a wheel of this checkout in a new environment takes an epoch."""

from __future__ import annotations

import os
import subprocess
import sys
import venv
from pathlib import Path

import pytest

from thermocald.store.database.store import Store

ROOT = Path(__file__).resolve().parents[2]

pytestmark = pytest.mark.slow


@pytest.fixture(scope="module")
def installed(tmp_path_factory) -> Path:
    """The command in an environment as pipx makes it, with the tests' dependencies."""
    folder = tmp_path_factory.mktemp("pipx")
    built = subprocess.run(
        [sys.executable, "-m", "pip", "wheel", "--quiet", "--no-deps", "-w", folder, str(ROOT)],
        capture_output=True, text=True, check=False,
    )  # fmt: skip
    if built.returncode:
        pytest.skip(f"no wheel can be built here: {built.stderr.strip().splitlines()[-1]}")
    (wheel,) = folder.glob("thermocald-*.whl")
    venv.create(folder / "venv", with_pip=True)
    python = folder / "venv/bin/python"
    subprocess.run([python, "-m", "pip", "install", "--quiet", "--no-deps", wheel], check=True)
    (packages,) = (folder / "venv/lib").glob("python*/site-packages")
    # a plain path, so that the editable install of the checkout is not used
    (packages / "dependencies.pth").write_text(
        "\n".join(path for path in sys.path if path.endswith("-packages")) + "\n"
    )
    return folder / "venv/bin/thermocald"


def test_it_runs_from_the_wheel_alone(installed, tmp_path):
    environment = {k: v for k, v in os.environ.items() if k != "PYTHONPATH"}
    done = subprocess.run(
        [installed, "run", "--mock", "--epochs", "1", "--store", "mock.db"],
        cwd=tmp_path, env=environment, capture_output=True, text=True, check=False, timeout=300,
    )  # fmt: skip
    assert done.returncode == 0, done.stderr
    with Store.open(tmp_path / "mock.db") as store:
        (series,) = store.all_series()
        assert store.series_columns(series, ["status"])["status"].tolist() == ["ok"]
    where = subprocess.run(
        [installed.with_name("python"), "-c", "import thermocald; print(thermocald.__file__)"],
        cwd=tmp_path, env=environment, capture_output=True, text=True, check=True,
    )  # fmt: skip
    assert Path(where.stdout.strip()).is_relative_to(installed.parents[1])


def test_the_wheel_has_every_file_of_the_package(installed):
    """Templates, style sheets, the dashboard's page and py.typed, beside the modules."""
    (package,) = (installed.parents[1] / "lib").glob("python*/site-packages/thermocald")
    here, there = (
        {p.relative_to(folder).as_posix() for p in folder.rglob("*")
         if p.is_file() and p.suffix != ".pyc"}
        for folder in (ROOT / "thermocald", package)
    )  # fmt: skip
    assert here == there
    others = {name for name in here if not name.endswith(".py")}
    assert {"py.typed", "templates/report.html.j2", "output/dashboard/static/page.js"} <= others
