#!/bin/bash
# Build the phone of the laboratory: Debian trixie's adbd in a folder. build.sh FOLDER
set -euo pipefail
out=$1
begin=$SECONDS
rm -rf "$out/root"
mkdir -p "$out"
mmdebstrap --quiet --variant=minbase --components=main --include=adbd,procps --format=directory \
    --aptopt='APT::Install-Recommends "false"' \
    --dpkgopt='path-exclude=/usr/share/man/*' --dpkgopt='path-exclude=/usr/share/doc/*' \
    --dpkgopt='path-exclude=/usr/share/locale/*' \
    trixie "$out/root" >"$out/mmdebstrap.log" 2>&1
install -m 755 "$(dirname "$0")"/bin/* "$out/root/usr/local/bin/"
mkdir -p "$out/root/sdcard/DCIM/Camera" "$out/root/phone"
rm -rf "$out"/root/var/cache/apt/* "$out"/root/var/lib/apt/lists/*
echo done >"$out/built"
printf '[%4d s] phone built\n' $((SECONDS - begin))
