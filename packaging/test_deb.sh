#!/bin/bash
# Inside a bare Debian: install /share/first.deb, use it, upgrade to second.deb, downgrade, remove, purge.
# `test_deb.sh NAME depends` only installs its dependencies.
#
# ROOT is the folder of a Debian of another architecture: apt and dpkg run natively from here (those of
# Debian 13; an older dpkg handles only its own architecture), its own programs are emulated.
set -euo pipefail
name=${1:-here} ROOT=${ROOT:-}
inside() { if [ -n "$ROOT" ]; then chroot "$ROOT" "$@"; else "$@"; fi; }
if [ -n "$ROOT" ]; then
  architecture=$(cat "$ROOT/var/lib/dpkg/arch-native")
  cat > /etc/apt/apt.conf.d/00foreign <<END
APT::Architecture "$architecture";
APT::Architectures { "$architecture"; };
Dir::State::status "$ROOT/var/lib/dpkg/status";
Dir::Etc::sourcelist "$ROOT/etc/apt/sources.list";
Dir::Etc::sourceparts "$ROOT/etc/apt/sources.list.d";
DPkg::Options { "--root=$ROOT"; "--force-unsafe-io"; };
END
  for folder in proc dev; do mount --bind /$folder "$ROOT/$folder"; done
  printf '#!/bin/sh\nexec /usr/sbin/chroot %s "$@"\n' "$ROOT" > /tmp/inside
  # it would take hours of emulation, and imports make the bytecode too
  printf '#!/bin/sh\nexit 0\n' > "$ROOT/usr/bin/py3compile"
fi
fail() { echo "$name: $*" >&2; exit 1; }
ready=0
lap() { taken=$((SECONDS - began)) began=$SECONDS; ready=$((ready + taken)); echo "$name: $1 in $taken s"; }
apt_get() { apt-get -y -qq --no-install-recommends "$@" >/tmp/apt.log 2>&1 || { tail -n 30 /tmp/apt.log; exit 1; }; }
began=$SECONDS
cd /tmp
apt-get update -qq || { echo "$name: no package lists, no network?"; exit 77; }
if [ "${2:-}" = depends ]; then
  apt_get satisfy "$(dpkg-deb --field /share/first.deb Depends)"
  lap "dependencies downloaded and installed"
  exit
fi
apt_get install --download-only /share/first.deb
lap "dependencies downloaded"

ready=0
apt_get install /share/first.deb
lap "installed"
inside thermocald --version
inside getent passwd thermocald >/dev/null || fail "no user thermocald"
inside id -nG thermocald | grep -qw video || fail "the user may not open cameras"
[ "$(inside stat -c '%U %a' /var/lib/thermocald)" = "thermocald 750" ] || fail "/var/lib/thermocald is not the user's own"
test -e "$ROOT/usr/lib/udev/rules.d/60-thermocald.rules" || fail "no rules for udev"
test -e "$ROOT/usr/lib/systemd/system/thermocald.service" || fail "no unit"
grep -q '^ExecStart=/usr/bin/thermocald' "$ROOT/usr/lib/systemd/system/thermocald.service" || fail "the unit runs another program"
[ -z "$(find "$ROOT/etc/systemd/system" -name 'thermocald*')" ] || fail "a unit was enabled"
zgrep -q thermocald "$ROOT/usr/share/man/man1/thermocald.1.gz" 2>/dev/null || grep -qs 'path-exclude=/usr/share/man' "$ROOT"/etc/dpkg/dpkg.cfg.d/* || fail "no manual page"
inside thermocald check /etc/thermocald/config.yaml >/dev/null
# the private environment sees what the distribution installs (picamera2, libcamera)
inside /usr/lib/thermocald/bin/python -c 'import sys, yaml; assert "/usr/lib/python3/dist-packages" in sys.path' ||
  fail "the system's modules are not seen"
# into a file: `grep -q` exits at the first match, and a program that still writes would then fail
inside thermocald doctor >/tmp/doctor || [ $? = 1 ] || fail "the doctor fails"
grep -q 'does not start with the machine' /tmp/doctor || fail "the doctor does not see the service"
run() { inside su -s /bin/sh thermocald -c "cd /var/lib/thermocald && $1"; }
if [ -d /share/M1 ]; then # identical (.ci/arm64), and saves a minute of emulation
  cp -r /share/M1 "$ROOT/var/lib/thermocald"
else
  run "thermocald simulate --preset nexus5-cold --out M1 >/dev/null 2>&1"
  lap "simulated"
fi
run "thermocald replay M1 --store series.db >/dev/null 2>&1"
lap "first replayed epochs"
# the bound is for a real machine, not an emulated one
echo "$name: from a bare machine to replayed epochs in $ready s, without the download"
[ -n "$ROOT" ] || [ $ready -le 300 ] || fail "that is more than 5 minutes"
[ -n "${DEB_SHORT:-}" ] || { run "thermocald demo --epochs 20 --no-discovery --out demo >/dev/null"; lap "demo of 20 epochs"; }
if [ -z "$ROOT" ] && apt-cache show python3-libcamera >/dev/null 2>&1; then
  apt_get install python3-libcamera
  /usr/lib/thermocald/bin/python -c 'from libcamera import controls; controls.AnalogueGain' || fail "libcamera is not found"
  lap "libcamera found"
fi
echo "# mine" >> "$ROOT/etc/thermocald/config.yaml"
run "thermocald export series.db --output first.csv"
# SQLite's user_version, read at its place in the file
schema() { od -An -tu4 --endian=big -j60 -N4 "$ROOT/var/lib/thermocald/$1" | tr -d ' '; }
old=$(schema series.db)

apt_get install /share/second.deb
lap "upgraded"
version=$(dpkg ${ROOT:+--root="$ROOT"} -s thermocald | sed -n 's/^Version: //p')
[[ $version == *+1 ]] || fail "it was not upgraded: $version"
grep -q '^# mine' "$ROOT/etc/thermocald/config.yaml" || fail "the upgrade lost the configuration"
run "test -e M1/epochs.csv" || fail "the upgrade lost data"
inside thermocald --version >/dev/null
# its schema is one version later: a reader changes nothing, a writer copies the store first
run "thermocald export series.db --output second.csv"
run "cmp first.csv second.csv" || fail "the store reads differently after the upgrade"
[ "$(schema series.db)" = "$old" ] || fail "reading changed the store"
run "thermocald replay M1 --store series.db >/dev/null"
[ "$(schema series.db)" = $((old + 1)) ] || fail "the store was not brought up to date"
[ "$(schema series.db.version-$old)" = "$old" ] || fail "the store has no backup"
lap "schema brought up to date"

apt_get install --allow-downgrades /share/first.deb
lap "downgraded"
grep -q '^# mine' "$ROOT/etc/thermocald/config.yaml" || fail "the downgrade lost the configuration"
# the store with the later schema is left alone, with a message; the backup can be used
! run "thermocald export series.db --output third.csv 2>refusal" || fail "a later store was opened"
run "cat refusal"
run "grep -q 'update thermocald' refusal && grep -q series.db.version-$old refusal" || fail "the message does not tell what to do"
[ "$(schema series.db)" = $((old + 1)) ] || fail "a later store was changed"
run "thermocald export series.db.version-$old --output third.csv && cmp first.csv third.csv" ||
  fail "the backup cannot be used"
lap "backup read"

apt_get remove thermocald
test ! -e "$ROOT/usr/bin/thermocald" || fail "the command is still there"
test -e "$ROOT/etc/thermocald/config.yaml" || fail "remove deleted the configuration"
test -e "$ROOT/var/lib/thermocald/M1/epochs.csv" || fail "remove deleted data"
[ -z "$(find "$ROOT/usr/lib/thermocald" 2>/dev/null)" ] || fail "files remain: $(find "$ROOT/usr/lib/thermocald" | head -n 3)"
lap "removed"
apt_get purge thermocald
test ! -e "$ROOT/etc/thermocald" || fail "purge left /etc/thermocald"
test ! -e "$ROOT/var/lib/thermocald" || fail "purge left /var/lib/thermocald"
lap "purged"
