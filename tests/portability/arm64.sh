#!/usr/bin/env bash
# Plan on an emulated ARM64 processor and compare with digests.json. Needs Debian 12 on x86-64, root or the packages
# qemu-user-static and debootstrap, a package index, and some ten minutes, most of which LLVM takes under emulation.
#     bash tests/portability/arm64.sh [FOLDER] [--quick]
set -euo pipefail
here="$(cd "$(dirname "${BASH_SOURCE[0]}")" && pwd)"
root="$(cd "$here/../.." && pwd)"
folder="${1:-$(mktemp -d)}"
mkdir -p "$folder"

command -v qemu-aarch64-static debootstrap > /dev/null || apt-get install -y --no-install-recommends qemu-user-static debootstrap
if [ ! -e "$folder/debian/usr/bin/python3.11" ]; then
  # Unpacked only: nothing of it is configured or run by the system.
  debootstrap --arch=arm64 --foreign --variant=minbase --include=python3,libpython3-stdlib bookworm "$folder/debian"
  for package in "$folder"/debian/var/cache/apt/archives/*.deb; do dpkg-deb -x "$package" "$folder/debian"; done
fi
platforms=(manylinux_2_17_aarch64 manylinux2014_aarch64 manylinux_2_27_aarch64 manylinux_2_28_aarch64)
python3 -m pip install --quiet --upgrade --target "$folder/packages" "${platforms[@]/#/--platform=}" --python-version 3.11 \
  --only-binary=:all: --constraint "$root/constraints.txt" gymnasium numba numpy pettingzoo pydantic pyyaml rich typer

PYTHONPATH="$folder/packages:$root" NUMBA_CACHE_DIR="$folder/cache" qemu-aarch64-static -L "$folder/debian" \
  "$folder/debian/usr/bin/python3.11" "$here/plans.py" "${@:2}" > "$folder/digests.json"
python3 - "$here/digests.json" "$folder/digests.json" << 'END'
import json, sys
expected, found = (json.load(open(path)) for path in sys.argv[1:])
different = [name for name, value in found.items() if value != expected[name]]
sys.exit(f"different: {', '.join(different)}" if different else print(f"ARM64: {len(found)} plans, the same"))
END
