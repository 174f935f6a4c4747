# First program of a PID and mount namespace: runs the command $1 in the clone of the root $FOLDER, with
# this kernel's devices and a /tmp and /dev/shm of its own. All mounts end with the namespace.
set -e
mount --make-rprivate /
mount -t proc proc "$FOLDER/proc"
mount --rbind /sys "$FOLDER/sys"
mount --rbind /dev "$FOLDER/dev"
mount -t tmpfs tmpfs "$FOLDER/dev/shm"
mount -t devpts -o newinstance,ptmxmode=666,mode=620,gid=5 devpts "$FOLDER/dev/pts"
[ -e "$FOLDER/dev/ptmx" ] && mount --bind "$FOLDER/dev/pts/ptmx" "$FOLDER/dev/ptmx"
exec chroot "$FOLDER" sh -c 'unset FOLDER; cd /src/syntopic && exec sh -c "$0"' "$1"
