#!/bin/sh
# Builds the image of the Containerfile, or, where containers cannot be built, the same system in a folder.
#   packaging/container.sh image     podman or docker; the image membrane-ctrl
#   packaging/container.sh chroot    as root: the folder build/container/root, and a hold of the twin in it
# The base is made of Debian's packages by mmdebstrap: no image is downloaded.
set -eu
cd "$(dirname "$0")/.."
out=build/container
python=${PYTHON:-.venv/bin/python}
packages=python3,python3-venv,ca-certificates,libglib2.0-0

make_base() {  # $1: a .tar file, or a folder
    mmdebstrap --quiet --variant=minbase --include="$packages" bookworm "$1"
}

make_wheel() {
    rm -rf "$out/wheel" && mkdir -p "$out/wheel"
    "$python" -m pip wheel --quiet --no-deps --no-build-isolation --wheel-dir "$out/wheel" .
    cp requirements.lock packaging/install.sh "$out/wheel/"
}

case ${1:-image} in
image)
    make_wheel
    make_base "$out/base.tar"
    cp Containerfile "$out/"
    builder=$(command -v podman || command -v docker)
    "$builder" build --tag membrane-ctrl --file "$out/Containerfile" "$out"
    ;;
chroot)
    make_wheel
    rm -rf "$out/root"
    make_base "$out/root"
    mkdir -p "$out/root/opt/membrane-ctrl"
    cp "$out"/wheel/* "$out/root/opt/membrane-ctrl/"
    cp /etc/resolv.conf "$out/root/etc/resolv.conf"
    chroot "$out/root" sh /opt/membrane-ctrl/install.sh
    du -sm "$out/root" "$out/root/opt/membrane-ctrl/.venv"
    ;;
*)
    echo "usage: packaging/container.sh image|chroot" >&2
    exit 2
    ;;
esac
