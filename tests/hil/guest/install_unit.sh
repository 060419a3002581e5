#!/bin/sh
# Install thermocald's unit with its users and rules: install_unit.sh FOLDER
set -eu
folder=$1
for group in video dialout plugdev i2c gpio; do
    getent group $group >/dev/null || groupadd -r $group
done
for file in "$folder"/*sysusers*; do
    [ -e "$file" ] && cp "$file" /usr/lib/sysusers.d/thermocald.conf && systemd-sysusers
done
getent passwd thermocald >/dev/null || useradd -r -d /var/lib/thermocald -s /usr/sbin/nologin thermocald
for file in "$folder"/*tmpfiles*; do
    [ -e "$file" ] && cp "$file" /usr/lib/tmpfiles.d/thermocald.conf && systemd-tmpfiles --create
done
for file in "$folder"/*.rules "$folder"/udev/*.rules; do
    [ -e "$file" ] && cp "$file" /etc/udev/rules.d/
done
udevadm control --reload
udevadm trigger
udevadm settle
mkdir -p /opt/thermocald/bin
printf '#!/bin/sh\nexec /usr/bin/python3 -m thermocald "$@"\n' >/opt/thermocald/bin/thermocald
chmod 755 /opt/thermocald/bin/thermocald
chmod -R a+rX /opt/thermocald /etc/thermocald
cp "$folder"/thermocald.service /etc/systemd/system/
# only for the slow emulated machine: other times, and a traceback of crashes
mkdir -p /etc/systemd/system/thermocald.service.d
printf '[Service]\nEnvironment=PYTHONFAULTHANDLER=1\nTimeoutStartSec=240\nWatchdogSec=20\nTimeoutAbortSec=5\nRestartSec=1\n' \
    >/etc/systemd/system/thermocald.service.d/times.conf
systemctl daemon-reload
