# First program of a PID namespace: a machine of its own for systemd, on this host's files. Nothing of
# the host is written to: what systemd and the service write goes to tmpfs and to $PLACE. Every unit that
# is started here has DefaultDependencies=no: sysinit.target would set up the host's folders and devices.
# Needs PLACE (writable), REPOSITORY, PYTHON (its prefix), PACKAGES (site-packages), PATH.
set -e
mount --make-rprivate /
mount -t proc proc /proc
mount --bind /proc/sys /proc/sys
mount -o remount,ro,bind /proc/sys
umount -l /sys/fs/cgroup
mount -t cgroup2 cgroup2 /sys/fs/cgroup
mount --bind "$PLACE" /mnt
mkdir -p /mnt/etc
mount -t tmpfs tmpfs /mnt/etc
cp -a /etc/. /mnt/etc/
mount --bind /mnt/etc /etc
for place in /run /var/lib /var/log /opt; do
    mount -t tmpfs tmpfs "$place"
done
mkdir -p /mnt/cache /etc/sysusers.d /var/lib/systemd /opt/syntopic/bin
mount --bind /mnt/cache /var/cache
# Paths that the unit lets be seen, wherever these lie: it hides home folders and /tmp.
for from in "$PYTHON:python" "$REPOSITORY:repository" "$PACKAGES:packages"; do
    mkdir -p "/opt/${from##*:}"
    mount --bind "${from%:*}" "/opt/${from##*:}"
done
REPOSITORY=/opt/repository
# systemd empties /tmp at boot (tmpfiles.d); these are the ones of this machine from here on.
mount -t tmpfs tmpfs /tmp
mount -t tmpfs tmpfs /var/tmp
rm -rf /etc/systemd/system
mkdir -p /etc/systemd/system/service.d /etc/systemd/system/timer.d
# Nothing but the units below is started: no udev, no tmpfiles, no sysctl of a whole machine.
printf '[Unit]\nDefaultDependencies=no\n' >/etc/systemd/system/service.d/alone.conf
printf '[Unit]\nDefaultDependencies=no\n' >/etc/systemd/system/timer.d/alone.conf
mkdir -p /etc/systemd/system/syntopic.service.d /etc/systemd/system/syntopic-disk-health.service.d
echo 0123456789abcdef0123456789abcdef >/etc/machine-id
cp "$REPOSITORY/systemd/sysusers.conf" /etc/sysusers.d/syntopic.conf
systemd-sysusers /etc/sysusers.d/syntopic.conf
cat >/opt/syntopic/bin/syntopic <<SH
#!/bin/sh
export LD_LIBRARY_PATH=/opt/python/lib PYTHONPATH=/opt/repository:/opt/packages PYTHONDONTWRITEBYTECODE=1
exec /opt/python/bin/python3 -m daemon "\$@"
SH
chmod 755 /opt/syntopic/bin/syntopic
cp "$REPOSITORY"/systemd/*.service "$REPOSITORY"/systemd/*.timer /etc/systemd/system/
cp "$REPOSITORY"/tests/installed/units/*.service /etc/systemd/system/
cp "$REPOSITORY/tests/installed/units/flight.conf" /etc/systemd/system/syntopic.service.d/
# One disk that answers: whatever disks this machine has, and whether smartctl is installed.
mkdir -p /opt/stub
cat >/opt/stub/smartctl <<'SH'
#!/bin/sh
case $1 in
--scan) echo '{"devices": [{"name": "/dev/nvme0", "type": "nvme"}]}' ;;
*) echo '{"model_name": "Composed", "serial_number": "N0001", "smart_status": {"passed": true}}' ;;
esac
SH
chmod 755 /opt/stub/smartctl
printf '[Service]\nEnvironment=PATH=/opt/stub:/usr/bin:/bin\n' \
    >/etc/systemd/system/syntopic-disk-health.service.d/stub.conf
printf '[Unit]\nDefaultDependencies=no\nWants=flight.service\n' >/etc/systemd/system/flight.target
exec env -i container=test PATH=/usr/sbin:/usr/bin:/sbin:/bin REPOSITORY="$REPOSITORY" \
    /lib/systemd/systemd --system --unit=flight.target --log-target=console --show-status=1
