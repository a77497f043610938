#!/bin/sh
# Removes from an environment what a machine that only holds and measures does without: the viewer's program, symbols
# of libraries, tests, headers and type stubs of packages, pyarrow's clients of Flight and S3, pip and setuptools.
# `membrane-ctrl review` then needs another machine.
#   packaging/slim.sh /opt/membrane-ctrl/.venv
set -eu
packages=$(echo "$1"/lib/python3*/site-packages)
before=$(du -sm "$1" | cut -f1)
rm -f "$packages"/rerun_cli/rerun
find "$packages" -type d \( -name tests -o -name include \) -prune -exec rm -rf {} +
find "$packages" -type f -name "*.pyi" -delete
rm -f "$packages"/pyarrow/libarrow_flight.so* "$packages"/pyarrow/libarrow_python_flight.so* "$packages"/pyarrow/_flight.*
rm -f "$packages"/pyarrow/libarrow_s3.so* "$packages"/pyarrow/_s3fs.*
for name in pip setuptools pkg_resources; do
    rm -rf "$packages/$name" "$packages/$name"-*.dist-info
done
rm -f "$packages"/distutils-precedence.pth
if command -v strip >/dev/null; then
    strip --strip-unneeded "$packages"/rerun_bindings/*.so "$packages"/llvmlite/binding/*.so
fi
echo "$1: $before MB before, $(du -sm "$1" | cut -f1) MB now"
