#!/bin/sh
# Installs membrane-ctrl, without a network, from the wheels in /opt/membrane-ctrl of a Debian system. The Containerfile
# runs it in an image, `packaging/container.sh chroot` in a folder.
set -eu
cd /opt/membrane-ctrl
python3 -m venv .venv
wheel=$(ls membrane_ctrl-*.whl)
.venv/bin/pip install --no-cache-dir --disable-pip-version-check --no-index --find-links wheels \
    -c requirements.lock "./${wheel}[alarms,web,gpio]"
rm -rf wheels
sh slim.sh .venv
ln -sf /opt/membrane-ctrl/.venv/bin/membrane-ctrl /usr/local/bin/membrane-ctrl
useradd --system --user-group --home-dir /var/lib/membrane-ctrl --create-home --shell /usr/sbin/nologin membrane
usermod --append --groups dialout,video membrane
membrane-ctrl --version
