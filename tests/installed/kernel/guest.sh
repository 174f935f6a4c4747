#!/bin/busybox sh
# First program of the virtual machine. Its root file system is the host's, read-only over 9p, so
# that the same checkout and .venv run at the same path; what is written goes to /dev/kernel-guest.
b=/bin/busybox
$b mkdir -p /proc /sys /dev /host
$b mount -t proc proc /proc
$b mount -t sysfs sys /sys
$b mount -t devtmpfs dev /dev
for module in $($b cat /modules.load); do
    $b insmod "/modules/$module" || echo "guest: $module cannot be loaded"
done
share="trans=virtio,version=9p2000.L,msize=1048576"
$b mount -t 9p -o "$share,ro,cache=loose" host /host || { echo "guest: no root"; $b poweroff -f; }
$b mkdir -p /dev/shm /dev/kernel-guest/out /dev/kernel-guest/tmp
$b mount -t tmpfs shm /dev/shm
$b cp -r /modules /dev/kernel-guest/modules
$b mount -t 9p -o "$share,rw,cache=none" out /dev/kernel-guest/out
for place in proc sys dev; do
    $b mount --move "/$place" "/host/$place"
done
$b ifconfig lo 127.0.0.1 up 2>/dev/null
$b chroot /host /bin/sh /dev/kernel-guest/out/command.sh </dev/null
echo $? >/host/dev/kernel-guest/out/status
$b sync
$b mount -t proc proc /proc
$b poweroff -f
