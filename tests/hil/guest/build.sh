#!/bin/bash
# Build the guest of the laboratory: kernel, initial RAM disk, root file system. build.sh FOLDER
#
# A small Debian 12 with systemd, Python, the drivers' libraries, and v4l2loopback built for its
# kernel. thermocald is copied in at each run, so that a change of the program does not rebuild the
# guest. Needs root, apt and a Python package index.
set -euo pipefail
out=$1
here=$(cd "$(dirname "$0")" && pwd)
checkout=$(cd "$here/../../.." && pwd)
python=${PYTHON:-python3}
work=$out/work
rm -rf "$work"
mkdir -p "$work"
begin=$SECONDS
say() { printf '[%4d s] %s\n' $((SECONDS - begin)) "$*"; }

headers=$(dpkg-query -W -f '${Depends}' linux-headers-amd64 | grep -o 'linux-headers-[0-9.-]*-amd64')
version=${headers#linux-headers-}
say "kernel $version"

# the root file system, in the background
packages=systemd,systemd-sysv,dbus,udev,kmod,python3,openssh-server,iproute2,procps,e2fsprogs
packages=$packages,dmsetup,mosquitto
mmdebstrap --quiet --variant=minbase --components=main --include=$packages --format=directory \
    --aptopt='APT::Install-Recommends "false"' \
    --dpkgopt='path-exclude=/usr/share/man/*' --dpkgopt='path-exclude=/usr/share/doc/*' \
    --dpkgopt='path-exclude=/usr/share/locale/*' \
    bookworm "$work/root" >"$work/mmdebstrap.log" 2>&1 &
rootfs=$!

# the libraries for Debian 12's Python 3.11, likewise
"$python" - "$checkout/pyproject.toml" >"$work/requirements.txt" <<'X'
import sys, tomllib
project = tomllib.load(open(sys.argv[1], "rb"))["project"]
extras = project["optional-dependencies"]
print("\n".join(project["dependencies"] + extras["v4l2"] + extras["mqtt"] + extras["dashboard"]))
X
"$python" -m pip install -q --disable-pip-version-check --no-warn-script-location \
    --only-binary :all: --python-version 3.11 --target "$work/site" -r "$work/requirements.txt" \
    >"$work/pip.log" 2>&1 &
libraries=$!

# v4l2loopback, built against the headers of the guest's kernel
mkdir -p "$work/deb"
(cd "$work/deb" && apt-get download -qq "linux-image-$version" v4l2loopback-dkms >"$work/apt.log" 2>&1)
dpkg-deb -x "$work"/deb/linux-image-*.deb "$work/kernel"
dpkg-deb -x "$work"/deb/v4l2loopback-dkms_*.deb "$work/loopback"
loopback=$(echo "$work"/loopback/usr/src/v4l2loopback-*)
make -s -C "/usr/src/linux-headers-$version" M="$loopback" modules >"$work/loopback.log" 2>&1
say "v4l2loopback built"

wait $libraries
find "$work/site" -depth -type d \( -name tests -o -name __pycache__ \) -exec rm -rf {} +
say "libraries"
wait $rootfs
root=$work/root
say "root file system"

# the laboratory's kernel modules with their dependencies
modules=$root/usr/lib/modules/$version
mkdir -p "$modules/extra"
depmod -b "$work/kernel" "$version"
for name in virtio_pci virtio_blk virtio_net virtio_rng ext4 crc32c_generic 9p 9pnet_virtio \
    autofs4 loop videodev vivid i2c-dev i2c-stub lm75 bmp280-i2c xhci-pci ftdi_sio \
    dm-log-writes w1_therm ds2490; do
    modprobe -d "$work/kernel" -S "$version" --show-depends "$name" |
        awk '$1 == "insmod" { print $2 }'
done | sort -u | while read -r file; do
    to=$modules/${file#*/lib/modules/"$version"/}
    mkdir -p "$(dirname "$to")"
    cp "$file" "$to"
done
cp "$loopback/v4l2loopback.ko" "$modules/extra/"
strip -g "$modules/extra/v4l2loopback.ko"
cp "$work/kernel/lib/modules/$version"/modules.{order,builtin,builtin.modinfo} "$modules/"
depmod -b "$root" "$version"

# its configuration
mkdir -p "$root/opt" "$root/root/.ssh" "$root/mnt/host"
mv "$work/site" "$root/opt/site"
printf '/opt/thermocald\n/opt/site\n' >"$root/usr/lib/python3/dist-packages/laboratory.pth"
[ -f "$out/key" ] || ssh-keygen -q -t ed25519 -N '' -C laboratory -f "$out/key"
install -m 600 "$out/key.pub" "$root/root/.ssh/authorized_keys"
chmod 700 "$root/root/.ssh"
echo laboratory >"$root/etc/hostname"
printf '[Match]\nName=eth*\n[Network]\nDHCP=yes\n' >"$root/etc/systemd/network/eth.network"
printf '/dev/vda / ext4 noatime 0 1\nhost /mnt/host 9p trans=virtio,version=9p2000.L,nofail 0 0\n' \
    >"$root/etc/fstab"
printf 'listener 1883 127.0.0.1\nallow_anonymous true\n' >"$root/etc/mosquitto/conf.d/laboratory.conf"
chroot "$root" systemctl enable -q systemd-networkd ssh
chroot "$root" systemctl disable -q mosquitto
chroot "$root" systemctl mask -q apt-daily.timer apt-daily-upgrade.timer dpkg-db-backup.timer \
    e2scrub_all.timer fstrim.timer systemd-timesyncd systemd-pstore >/dev/null 2>&1 || true
rm -rf "$root"/var/cache/apt/* "$root"/var/lib/apt/lists/*
# compiled here, because the emulated machine is slow
chroot "$root" python3 -m compileall -q -j 2 /opt/site >/dev/null 2>&1 || true
say "configured"

rm -f "$out/root.ext4"
mke2fs -q -t ext4 -E lazy_itable_init=1 -d "$root" "$out/root.ext4" 1800M
say "image"

# the initial RAM disk, which mounts /dev/vda
ram=$work/initrd
mkdir -p "$ram"/{bin,lib,proc,sys,dev,root}
cp /bin/busybox "$ram/bin/"
for name in virtio_pci virtio_blk ext4 crc32c_generic; do
    modprobe -d "$root" -S "$version" --show-depends "$name" | awk '$1 == "insmod" { print $2 }'
done | awk '!seen[$0]++' | while read -r file; do
    cp "$file" "$ram/lib/"
    basename "$file" >>"$ram/modules"
done
cat >"$ram/init" <<'X'
#!/bin/busybox sh
bb=/bin/busybox
$bb mount -t proc proc /proc
$bb mount -t sysfs sysfs /sys
$bb mount -t devtmpfs dev /dev
while read -r module; do $bb insmod "/lib/$module"; done </modules
$bb mount -t ext4 -o rw,noatime /dev/vda /root || exec $bb sh
$bb mount --move /dev /root/dev
$bb umount /proc /sys
exec $bb switch_root /root /sbin/init
X
chmod +x "$ram/init"
(cd "$ram" && find . | cpio -o -H newc --quiet | gzip -1) >"$out/initrd"
cp "$work/kernel/boot/vmlinuz-$version" "$out/kernel"
rm -rf "$work/kernel" "$work/deb" "$work/root" "$work/initrd"
echo done >"$out/built"
say "guest built, $(du -h "$out/root.ext4" | cut -f1)"
