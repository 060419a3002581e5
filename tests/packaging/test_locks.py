"""The locks and pyproject.toml's bounds hold together."""

from __future__ import annotations

import re
import tomllib
from pathlib import Path

import pytest
from packaging.requirements import Requirement
from packaging.utils import canonicalize_name

ROOT = Path(__file__).resolve().parents[2]
LOCKS = ROOT / "packaging/lock"
PROJECT = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]
RUNTIME = ("dashboard", "report", "android", "v4l2", "mqtt", "gpio", "server")
RELEASES = ("bookworm", "trixie")


def required(*extras: str) -> dict[str, Requirement]:
    """The direct dependencies, by name."""
    lines = [*PROJECT["dependencies"]]
    for extra in extras:
        lines += PROJECT["optional-dependencies"][extra]
    found = [Requirement(line) for line in lines]
    return {canonicalize_name(r.name): r for r in found if r.name != "thermocald"}


def pinned(path: Path) -> dict[str, set[str]]:
    """Every NAME==VERSION of a lock; a universal one may have several of a name."""
    found: dict[str, set[str]] = {}
    for name, version in re.findall(r"^([A-Za-z0-9._-]+)==([^\s;\\]+)", path.read_text(), re.M):
        found.setdefault(canonicalize_name(name), set()).add(version)
    return found


def test_the_lowest_are_those_that_the_bounds_name():
    lowest = pinned(LOCKS / "lowest.txt")
    for name, requirement in required(*RUNTIME, "dask", "parquet").items():
        (bound,) = (s.version for s in requirement.specifier if s.operator == ">=")
        (version,) = lowest[name]
        # the lowest release may be a later patch than the bound that it satisfies
        assert version.startswith(bound), f"{name}: lowest.txt has {version}, the bound is {bound}"


def test_the_lock_of_ci_serves_every_dependency():
    extras = [e for e in PROJECT["optional-dependencies"] if e not in ("benchmarks", "release")]
    locked = pinned(LOCKS / "development.txt")
    for name, requirement in required(*extras).items():
        assert locked[name], name
        assert all(requirement.specifier.contains(v) for v in locked[name]), name


@pytest.mark.parametrize("release", RELEASES)
def test_a_package_s_modules_are_debian_s_or_its_own(release):
    debian, own = pinned(LOCKS / f"{release}.in"), pinned(LOCKS / f"{release}.txt")
    for name, requirement in required(*RUNTIME).items():
        (version,) = own.get(name) or debian[name]
        assert requirement.specifier.contains(version), f"{name} {version}"
    depends = (ROOT / f"packaging/debian/depends.{release}").read_text()
    names = {"opencv-python-headless": "opencv", "pyserial": "serial", "pillow": "pil"}
    for name in set(debian) & set(required(*RUNTIME)) - set(own):
        short = names.get(name, name.removeprefix("py"))
        assert re.search(rf"python3-({re.escape(name)}|{re.escape(short)})\b", depends), name


@pytest.mark.parametrize("lock", ["development.txt", "runtime.txt", "bookworm.txt", "trixie.txt"])
def test_everything_locked_has_a_hash_and_no_address(lock):
    text = (LOCKS / lock).read_text()
    assert "://" not in text
    blocks = re.split(r"^(?=[A-Za-z0-9])", text, flags=re.M)[1:]
    assert all("--hash=sha256:" in block for block in blocks)
