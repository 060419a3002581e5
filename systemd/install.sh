#!/bin/sh
# Install or update thermocald as a service from this checkout (as root). --uninstall: remove it.
set -eu
here=$(cd "$(dirname "$0")" && pwd)
root=${DESTDIR:-}
units="thermocald.service thermocald@.service thermocald-dashboard.service thermocald-dashboard@.service
    thermocald-forward.service thermocald-forward@.service
    thermocald-archive.service thermocald-archive.timer thermocald-backup.service thermocald-backup.timer"

place() { install -D -m "$1" "$2" "$root$3"; echo "  $root$3"; }

if [ "${1:-}" = --uninstall ]; then
    [ -n "$root" ] || systemctl disable --now thermocald.service thermocald-dashboard.service thermocald-forward.service \
        thermocald-archive.timer thermocald-backup.timer || true
    for unit in $units; do rm -f "$root/etc/systemd/system/$unit"; done
    rm -f "$root/usr/lib/sysusers.d/thermocald.conf" "$root/usr/lib/tmpfiles.d/thermocald.conf" \
        "$root/etc/udev/rules.d/60-thermocald.rules"
    rm -rf "$root/opt/thermocald"
    echo "removed; /etc/thermocald and /var/lib/thermocald are kept"
    exit 0
fi

echo "files:"
for unit in $units; do place 644 "$here/$unit" "/etc/systemd/system/$unit"; done
place 644 "$here/thermocald.sysusers" /usr/lib/sysusers.d/thermocald.conf
place 644 "$here/thermocald.tmpfiles" /usr/lib/tmpfiles.d/thermocald.conf
place 644 "$here/60-thermocald.rules" /etc/udev/rules.d/60-thermocald.rules
[ -e "$root/etc/thermocald/config.yaml" ] ||
    place 644 "$here/../config.yaml" /etc/thermocald/config.yaml
[ -z "$root" ] || exit 0 # a package build: the rest is done on the target machine

echo "program in /opt/thermocald:"
[ -x /opt/thermocald/bin/python ] || python3 -m venv --system-site-packages /opt/thermocald
/opt/thermocald/bin/pip install --quiet --upgrade "$here/..[${EXTRAS:-dashboard}]"
for group in video dialout plugdev i2c gpio; do getent group $group >/dev/null || groupadd -r $group; done
systemd-sysusers thermocald.conf
systemd-tmpfiles --create thermocald.conf
udevadm control --reload && udevadm trigger || true
systemctl daemon-reload
sed -i 's|^  path: thermocald.db|  path: /var/lib/thermocald/thermocald.db|;s|^  folder: frames|  folder: /var/lib/thermocald/frames|' \
    /etc/thermocald/config.yaml
echo "next: edit /etc/thermocald/config.yaml, then  systemctl enable --now thermocald thermocald-archive.timer thermocald-backup.timer"
