#!/bin/sh
# Removes from an environment what a machine that only holds and measures does without: the viewer's program, symbols
# of libraries, tests and headers of packages, pip. `membrane-ctrl review` then needs another machine.
#   packaging/slim.sh /opt/membrane-ctrl/.venv
set -eu
packages=$(echo "$1"/lib/python3*/site-packages)
before=$(du -sm "$1" | cut -f1)
rm -f "$packages"/rerun_cli/rerun
find "$packages" -type d \( -name tests -o -name include \) -prune -exec rm -rf {} +
rm -rf "$packages"/pip "$packages"/pip-*.dist-info
if command -v strip >/dev/null; then
    strip --strip-unneeded "$packages"/rerun_bindings/*.so "$packages"/llvmlite/binding/*.so
fi
echo "$1: $before MB before, $(du -sm "$1" | cut -f1) MB now"
