#!/bin/bash
# A systemd of its own, as process 1 of new namespaces: its root is an overlay in memory, its control groups are a
# branch of their own, and nothing of it is left when the process that called this ends.
# Needs ROOM (a folder), ROOM_PYTHON (prefix of the interpreter), ROOM_VENV, ROOM_SOURCE (this repository).
set -eu

# Control group v2, as Debian 12 has it, or the branch beside the old ones
for tree in /sys/fs/cgroup /sys/fs/cgroup/unified; do
    [ "$(stat -f -c %T $tree 2>/dev/null)" = cgroup2fs ] && break
done
if [ -z "${ROOM_INSIDE:-}" ]; then
    mkdir "$tree/membrane-room-$$"
    echo $$ > "$tree/membrane-room-$$/cgroup.procs"
    export ROOM_INSIDE=1
    exec unshare --mount --propagation private --pid --fork --kill-child --cgroup --uts --ipc --net "$0"
fi

mount -t tmpfs tmpfs "$ROOM"
mkdir "$ROOM"/{changes,work,root}
mount -t overlay overlay -o "lowerdir=/,upperdir=$ROOM/changes,workdir=$ROOM/work" "$ROOM/root"
cd "$ROOM/root"
mount -t proc proc proc
mount -t sysfs sysfs sys
mount -t cgroup2 cgroup2 sys/fs/cgroup
for folder in run tmp dev; do mount -t tmpfs tmpfs $folder; done
for device in "null 1 3" "zero 1 5" "full 1 7" "random 1 8" "urandom 1 9" "tty 5 0"; do
    set -- $device
    mknod -m 666 "dev/$1" c "$2" "$3"
done
mkdir dev/shm dev/pts
mount -t tmpfs tmpfs dev/shm
mount -t devpts devpts dev/pts -o newinstance,ptmxmode=0666,mode=620,gid=5
ln -s pts/ptmx dev/ptmx
ln -s /proc/self/fd dev/fd

# The interpreter may be in somebody's home, which the service must not see: the places of the unit file instead
mkdir -p opt/python opt/source opt/packages opt/membrane-ctrl/.venv/bin opt/membrane-ctrl/.venv/lib run/units outside
mount --bind "$ROOM_PYTHON" opt/python
mount --bind "$ROOM_SOURCE" opt/source
version=$(basename "$(ls -d "$ROOM_VENV"/lib/python3.*)")
ln -s /opt/packages "opt/membrane-ctrl/.venv/lib/$version"
mount --bind "$ROOM_VENV/lib/$version" opt/packages
ln -s "/opt/python/bin/$version" opt/membrane-ctrl/.venv/bin/python3
printf 'home = /opt/python/bin\n' > opt/membrane-ctrl/.venv/pyvenv.cfg
sed '1s,.*,#!/opt/membrane-ctrl/.venv/bin/python3,' "$ROOM_VENV/bin/membrane-ctrl" > opt/membrane-ctrl/.venv/bin/membrane-ctrl
chmod 755 opt/membrane-ctrl/.venv/bin/membrane-ctrl

# No unit of this machine but the few that every service asks for
for unit in sysinit basic multi-user shutdown umount final exit sockets slices paths timers local-fs local-fs-pre; do
    cp /lib/systemd/system/$unit.target run/units
done
cp /lib/systemd/system/systemd-{exit.service,journald.service,journald.socket,journald-dev-log.socket} run/units
mkdir -p etc/systemd/journald.conf.d
printf '[Journal]\nStorage=volatile\nReadKMsg=no\nForwardToSyslog=no\n' > etc/systemd/journald.conf.d/room.conf
ip link set lo up
pivot_root . outside
umount -l /outside
export container=room SYSTEMD_UNIT_PATH=/run/units
unset ROOM_INSIDE
exec /lib/systemd/systemd --unit=basic.target --log-target=journal
