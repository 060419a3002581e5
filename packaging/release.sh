#!/bin/sh
# Build everything that is published into dist/, and test these artefacts, not the tree.
#
# sdist, wheel and Debian packages are built twice and must be identical; the sdist must give the same
# wheel. The wheel is installed with the locked versions in an environment of its own, and the sdist's
# tests are run on it there, without the tree. Debian packages are built if debhelper is installed; as
# root they are also installed, upgraded and purged in a bare Debian (.ci/deb). SBOM (CycloneDX) and
# checksums come last.
set -eu
cd "$(dirname "$0")/.."
python=$PWD/.venv/bin/python
[ -z "$(git status --porcelain --untracked-files=no)" ] ||
    { echo "there are uncommitted changes; commit them first: a release is a commit" >&2; exit 1; }
SOURCE_DATE_EPOCH=${SOURCE_DATE_EPOCH:-$(git log -1 --format=%ct)}
export SOURCE_DATE_EPOCH
version=$("$python" -c 'import thermocald; print(thermocald.__version__)')
work=$PWD/build/release
rm -rf "$work" dist
mkdir -p "$work" dist
same() { # FILE FOLDER: compare the file with that of its name in FOLDER
    cmp "$1" "$2/${1##*/}" || { echo "${1##*/} is not reproducible" >&2; exit 1; }
}

echo "== $version: sdist and wheel, twice"
"$python" -m pip install --quiet build twine 'cyclonedx-bom>=4' 'cyclonedx-python-lib[json-validation]'
for turn in 1 2; do
    rm -rf "$work/tree"
    git clone --quiet --no-hardlinks . "$work/tree"
    "$python" -m build --outdir "$work/$turn" "$work/tree" >"$work/build-$turn.log" 2>&1 ||
        { tail -n 20 "$work/build-$turn.log" >&2; exit 1; }
done
for file in "$work"/1/*; do
    same "$file" "$work/2"
    cp "$file" dist
done
rm -rf "$work/tree"
"$python" -m twine check --strict dist/*
wheel=thermocald-$version-py3-none-any.whl
tar -C "$work" -xzf "dist/thermocald-$version.tar.gz"
sdist=$work/thermocald-$version
"$python" -m pip wheel --quiet --no-deps --wheel-dir "$work/from-sdist" "$sdist"
same "dist/$wheel" "$work/from-sdist"

echo "== the wheel alone, with the locked versions"
"$python" -m venv --clear "$work/venv"
"$work/venv/bin/python" -m pip install --quiet --require-hashes --requirement packaging/lock/runtime.txt
"$work/venv/bin/python" -m pip install --quiet --no-deps "dist/$wheel"
"$work/venv/bin/python" -m pip check
(
    cd "$work"
    venv/bin/thermocald --version | grep -qx "$version"
    venv/bin/thermocald simulate --preset nexus5-cold --out M1 >simulate.log 2>&1
    venv/bin/thermocald replay M1 >replay.log 2>&1
    venv/bin/thermocald run --mock --epochs 1 --store mock.db >run.log 2>&1
    venv/bin/python -c 'import thermocald; assert "venv" in thermocald.__file__'
)

echo "== SBOM of the wheel's environment"
sbom=dist/thermocald-$version.cdx.json
"$python" -m cyclonedx_py environment --output-reproducible --output-format JSON \
    --output-file "$sbom" "$work/venv/bin/python"
"$work/venv/bin/python" -m pip list --format json 2>/dev/null >"$work/installed.json"
"$python" - "$sbom" "$work/installed.json" <<'END'
import json, sys
from cyclonedx.schema import SchemaVersion
from cyclonedx.validation.json import JsonStrictValidator

text, installed = (open(path, encoding="utf-8").read() for path in sys.argv[1:])
document = json.loads(text)
fault = JsonStrictValidator(SchemaVersion.from_version(document["specVersion"])).validate_str(text)
if fault:
    sys.exit(f"the SBOM is not valid: {fault}")
listed = {(c["name"].lower(), c["version"]) for c in document["components"]}
lacking = {(p["name"].lower(), p["version"]) for p in json.loads(installed)} - listed
if lacking:
    sys.exit(f"the SBOM lacks {sorted(lacking)}")
print(f"   valid, {len(listed)} components, thermocald among them")
END

echo "== the sdist's tests on the wheel"
# without the tree, tests can only import the installed packages
rm -rf "$sdist/thermocald" "$sdist/drivers"
# shellcheck disable=SC2046
"$work/venv/bin/python" -m pip install --quiet --no-deps \
    $(sed -nE 's/^((pytest|pytest-timeout|pytest-xdist|execnet|hypothesis|iniconfig|pluggy|sortedcontainers)==[^ ;]+).*/\1/p' \
        packaging/lock/development.txt)
(
    cd "$sdist"
    OPENBLAS_NUM_THREADS=1 "$work/venv/bin/python" -m pytest -q -n 2 --dist loadfile -p no:cacheprovider \
        tests/photogrammetry tests/simulation/test_heat.py tests/simulation/test_presets.py \
        tests/store/test_database.py tests/store/test_migration.py tests/store/test_recording.py \
        tests/cli/test_commands.py tests/cli/test_status.py tests/drivers/test_i2c.py tests/drivers/test_contract.py
)

packages=
if command -v dh >/dev/null; then
    for release in ${DEBIAN_RELEASES-bookworm trixie}; do
        for architecture in amd64 arm64; do
            echo "== Debian package for $release, $architecture"
            packaging/deb.sh $release $architecture
            packages="$packages $release-$architecture"
        done
    done
fi
if [ -n "$packages" ]; then
    # build the last one again
    packaging/deb.sh $release $architecture "$work/debian" >/dev/null
    same "dist/$(ls "$work/debian")" "$work/debian"
    echo "== Debian packages installed, upgraded, removed"
    status=0
    # shellcheck disable=SC2086
    DEBS=dist .ci/deb $(printf '%s\n' $packages | grep -- "-$(dpkg --print-architecture)\$") || status=$?
    case $status in
        0) ;;
        77) echo "   not possible here: run .ci/deb on a machine with root and a network" ;;
        *) exit $status ;;
    esac
else
    echo "== no Debian packages: debhelper is missing"
fi

echo "== notes: the newest section of the changelog"
awk '/^## /{section++; next} section == 1' CHANGELOG.md > "dist/NOTES-$version.md"
[ -s "dist/NOTES-$version.md" ] || echo "   the newest section is empty" >&2
(cd dist && sha256sum -- * > SHA256SUMS && sha256sum --quiet --check SHA256SUMS)
ls -l dist
