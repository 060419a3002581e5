#!/bin/sh
# Make everything that is published into dist/, and test the artefacts, not the tree.
#
# sdist and wheel are built twice and must be the same to the byte; the wheel is installed with the
# locked versions in an environment of its own and runs there; Debian packages are made where
# debhelper is; SBOM (CycloneDX) and checksums come last.
set -eu
cd "$(dirname "$0")/.."
python=$PWD/.venv/bin/python
SOURCE_DATE_EPOCH=${SOURCE_DATE_EPOCH:-$(git log -1 --format=%ct)}
export SOURCE_DATE_EPOCH
version=$("$python" -c 'import thermocald; print(thermocald.__version__)')
work=build/release
rm -rf "$work" dist
mkdir -p "$work" dist

echo "== $version: sdist and wheel, twice"
"$python" -m pip install --quiet build twine cyclonedx-bom
for turn in 1 2; do
    rm -rf "$work/tree"
    git clone --quiet --no-hardlinks . "$work/tree"
    "$python" -m build --outdir "$work/$turn" "$work/tree" >"$work/build-$turn.log" 2>&1 ||
        { tail -n 20 "$work/build-$turn.log" >&2; exit 1; }
done
for file in "$work"/1/*; do
    cmp "$file" "$work/2/${file##*/}" || { echo "${file##*/} is not reproducible" >&2; exit 1; }
    cp "$file" dist
done
"$python" -m twine check --strict dist/*

echo "== the wheel alone, with the locked versions"
"$python" -m venv --clear "$work/venv"
"$work/venv/bin/python" -m pip install --quiet --require-hashes --requirement packaging/lock/runtime.txt
"$work/venv/bin/python" -m pip install --quiet --no-deps "dist/thermocald-$version-py3-none-any.whl"
"$work/venv/bin/python" -m pip check
(
    cd "$work"
    venv/bin/thermocald --version | grep -qx "$version"
    venv/bin/thermocald simulate --preset nexus5-cold --out M1 >simulate.log 2>&1
    venv/bin/thermocald replay M1 >replay.log 2>&1
    venv/bin/thermocald run --mock --epochs 1 --store mock.db >run.log 2>&1
    venv/bin/python -c 'import thermocald; assert "venv" in thermocald.__file__'
)

echo "== SBOM of what the wheel was tested with"
"$python" -m cyclonedx_py environment --output-reproducible --output-format JSON \
    --output-file "dist/thermocald-$version.cdx.json" "$work/venv/bin/python"

if command -v dh >/dev/null; then
    for release in ${DEBIAN_RELEASES-bookworm trixie}; do
        for architecture in amd64 arm64; do
            echo "== Debian package for $release, $architecture"
            packaging/deb.sh $release $architecture
        done
    done
    echo "   they are installed, upgraded and purged by .ci/deb"
else
    echo "== no Debian packages: debhelper is missing"
fi

echo "== notes: the changelog's UNRELEASED part"
sed -n '/^## UNRELEASED/,/^## [^U]/p' CHANGELOG.md | sed '1d;/^## /d' > "dist/NOTES-$version.md"
(cd dist && sha256sum -- * > SHA256SUMS)
ls -l dist
