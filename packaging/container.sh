#!/bin/sh
# Builds the image of the Containerfile, or, where containers cannot be built, the same system in a folder.
#   packaging/container.sh image     podman, docker or buildah: the image membrane-ctrl, and a hold of the twin in it.
#                                    buildah needs no daemon and, with chroot isolation, no namespaces of its own
#   packaging/container.sh chroot    as root: the folder build/container/system, and a hold of the twin in it
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
    cp requirements.lock packaging/install.sh packaging/slim.sh "$out/wheel/"
    # downloaded here, so that nothing in the image or folder needs a network
    "$python" -m pip download --quiet --only-binary :all: --python-version 3.11 -c requirements.lock \
        --dest "$out/wheel/wheels" "$(ls "$out"/wheel/membrane_ctrl-*.whl)[alarms,web,gpio]"
}

# What each way runs at the end
hold="hold --twin --duration 20s --no-service"

case ${1:-image} in
image)
    make_wheel
    make_base "$out/base.tar"
    cp Containerfile "$out/"
    # podman or docker if it answers: a client without its daemon builds nothing
    builder=buildah
    for each in podman docker; do
        if "$each" info >/dev/null 2>&1; then
            builder=$each
            break
        fi
    done
    case $builder in
    buildah)
        export BUILDAH_ISOLATION="${BUILDAH_ISOLATION:-chroot}"
        buildah build --tag membrane-ctrl --file "$out/Containerfile" "$out"
        container=$(buildah from membrane-ctrl)
        # shellcheck disable=SC2086
        buildah run "$container" -- membrane-ctrl $hold
        buildah rm "$container" >/dev/null
        ;;
    *)
        "$builder" build --tag membrane-ctrl --file "$out/Containerfile" "$out"
        # shellcheck disable=SC2086
        "$builder" run --rm membrane-ctrl $hold
        ;;
    esac
    "$builder" images membrane-ctrl
    ;;
chroot)
    make_wheel
    rm -rf --one-file-system "$out/system"
    make_base "$out/system"
    mkdir -p "$out/system/opt/membrane-ctrl"
    cp -r "$out"/wheel/* "$out/system/opt/membrane-ctrl/"
    chroot "$out/system" sh /opt/membrane-ctrl/install.sh
    # the mounts are in a namespace of their own: none is left when it ends
    unshare --mount sh -eu -c '
        mount --rbind /dev "$1/dev" && mount -t proc proc "$1/proc"
        chroot "$1" su -s /bin/sh -c "$2" membrane
    ' sh "$out/system" "cd && membrane-ctrl $hold"
    du -sm "$out/system" "$out/system/opt/membrane-ctrl/.venv"
    ;;
*)
    echo "usage: packaging/container.sh image|chroot" >&2
    exit 2
    ;;
esac
