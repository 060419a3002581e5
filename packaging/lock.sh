#!/bin/sh
# Resolve the dependencies: the locks of CI and of the Debian packages (with hashes), and the lowest versions.
#   packaging/lock.sh [PACKAGE…]     # without a package, all are upgraded
set -eu
cd "$(dirname "$0")/.."
uv=${UV:-.venv/bin/uv}
locks=packaging/lock
upgrade=--upgrade
[ $# = 0 ] || upgrade=$(printf -- '--upgrade-package %s ' "$@")
runtime="--extra dashboard --extra report --extra android --extra v4l2 --extra mqtt --extra gpio --extra server"

resolve() { # OUT ARGUMENTS…: with the hashes of every wheel and without the address of an index
    out=$locks/$1; shift
    echo "$out"
    # shellcheck disable=SC2086
    "$uv" pip compile --quiet --no-header --no-emit-index-url --no-emit-find-links --generate-hashes \
        $upgrade "$@" --output-file "$out" pyproject.toml
}


# what CI and `make setup` install, for every supported Python
resolve development.txt --universal --python-version 3.11 --extra dev

# what users install: the container, and the environment in which a release is tested
# shellcheck disable=SC2086
resolve runtime.txt --universal --python-version 3.11 $runtime

# what the Debian packages contain: the modules that Debian lacks in a suitable version
for release in bookworm trixie; do
    own=""
    for module in $(sed -n 's/^\([a-z0-9-]*\)==.*/\1/p' "$locks/$release.in"); do
        own="$own --no-emit-package $module"
    done
    # shellcheck disable=SC2086
    resolve $release.txt $runtime $own --constraint "$locks/$release.in" \
        --python-version "$(sed -n 's/^# python //p' "$locks/$release.in")"
done

# the lowest versions that pyproject.toml allows; lowest.in limits indirect dependencies to versions that fit
"$uv" pip compile --quiet --no-header --no-annotate --no-emit-index-url --no-emit-find-links \
    --resolution lowest-direct --python-version 3.11 $runtime --extra dask --extra parquet \
    --upgrade \
    --constraint "$locks/lowest.in" --output-file "$locks/lowest.txt" pyproject.toml
