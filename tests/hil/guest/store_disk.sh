#!/bin/sh
# Mount the store's own disk: store_disk.sh logged|plain
# logged: flushed writes also go to /dev/vdc (dm-log-writes)
set -eu
at=/var/lib/thermocald/store
device=/dev/vdb
if [ "$1" = logged ]; then
    dmsetup create store --table "0 $(blockdev --getsz $device) log-writes $device /dev/vdc"
    device=/dev/mapper/store
fi
mkdir -p $at
mount -o nodiscard $device $at
chown thermocald: $at
