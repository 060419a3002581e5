#!/bin/sh
# Build the Debian package: packaging/deb.sh [RELEASE [ARCHITECTURE [FOLDER]]]
#
# RELEASE is bookworm or trixie, ARCHITECTURE amd64 or arm64; without them, this machine's. Nothing
# is compiled, so any Debian with debhelper builds all four packages. Modules that the release lacks
# in a suitable version are added as wheels, with the hashes of packaging/lock/RELEASE.txt.
set -eu
cd "$(dirname "$0")/.."
top=$PWD
here=$(. /etc/os-release && echo "${VERSION_CODENAME:-trixie}")
release=${1:-$here}
architecture=${2:-$(dpkg --print-architecture)}
out=$(mkdir -p "${3:-dist}" && cd "${3:-dist}" && pwd)
python=$top/.venv/bin/python
lock=$top/packaging/lock/$release

case $release in
    bookworm) number=12 ;;
    trixie) number=13 ;;
    *) echo "no lock file for $release; only bookworm and trixie have one" >&2; exit 2 ;;
esac
case $architecture in
    amd64) machine=x86_64 ;;
    arm64) machine=aarch64 ;;
    *) echo "no package can be built for $architecture, only for amd64 and arm64" >&2; exit 2 ;;
esac
for tool in dh dpkg-buildpackage; do
    command -v $tool >/dev/null || { echo "$tool is missing: sudo apt-get install debhelper dpkg-dev" >&2; exit 2; }
done

PYTHON=$(sed -n 's/^# python //p' "$lock.in")
PLATFORMS="manylinux_2_28_$machine manylinux_2_27_$machine manylinux_2_17_$machine manylinux2014_$machine any"
RELEASE=$release BUILD_PYTHON=$python
SOURCE_DATE_EPOCH=${SOURCE_DATE_EPOCH:-$(git log -1 --format=%ct)}
export PYTHON PLATFORMS RELEASE BUILD_PYTHON SOURCE_DATE_EPOCH
version=$("$python" -c 'import thermocald; print(thermocald.__version__)')+deb$number${DEB_REVISION:-}

work=$top/build/deb/$release-$architecture
tree=$work/thermocald
rm -rf "$work"
mkdir -p "$tree/wheels"
"$python" -m pip wheel --quiet --no-deps --wheel-dir "$tree/wheels" .
# adbutils is published for amd64 only, because of the adb in it, which Debian has itself
awk -v others="$work/others.txt" -v adb="$work/adb.txt" \
    '/^[a-z]/ { out = /^adbutils==/ ? adb : others } { print > out }' "$lock.txt"
load() { # REQUIREMENTS PLATFORM…
    requirements=$1; shift
    # shellcheck disable=SC2046
    "$python" -m pip download --quiet --no-deps --require-hashes --only-binary=:all: --implementation cp \
        --python-version "$PYTHON" $(printf -- '--platform %s ' "$@") --dest "$tree/wheels" -r "$requirements"
}
# shellcheck disable=SC2086
load "$work/others.txt" $PLATFORMS
load "$work/adb.txt" manylinux1_x86_64 manylinux2014_x86_64 any
for wheel in "$tree"/wheels/adbutils-*manylinux*.whl; do
    [ ! -e "$wheel" ] || mv "$wheel" "${wheel%manylinux*}any.whl"
done
"$python" packaging/manual.py "$tree/manual"
cp -r packaging/debian systemd docs config.yaml README.md "$tree"
find "$tree/docs" -name __pycache__ -prune -exec rm -rf {} +
cat > "$tree/debian/changelog" <<END
thermocald ($version) $release; urgency=medium

  * See docs/CHANGELOG.md in this folder.

 -- the thermocald founders <thermocald@localhost>  $(date -R -u -d "@$SOURCE_DATE_EPOCH")
END
cp CHANGELOG.md "$tree/docs"
cd "$tree"
if ! DEB_BUILD_OPTIONS=nocheck dpkg-buildpackage --host-arch="$architecture" --no-check-builddeps --build=binary \
    --no-sign > "$work/build.log" 2>&1; then
    tail -n 40 "$work/build.log" >&2
    exit 1
fi
cp "$work"/thermocald_*.deb "$out"
ls -l "$out"/thermocald_"$version"_"$architecture".deb
