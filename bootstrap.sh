#!/bin/sh
# Installs what Syntopic needs on a fresh Debian or Ubuntu machine: system packages through apt (as
# root, or with sudo; otherwise the exact line is printed), then a locked set of Python packages and
# Syntopic itself into .venv.
set -eu
cd "$(dirname "$0")"

PYTHON=${PYTHON:-python3}
# Heads: Aravis and its typelib. Building PyGObject: compiler, headers. venv: Debian keeps it apart. Certificates: openssl.
PACKAGES="gir1.2-aravis-0.8 libgirepository1.0-dev libcairo2-dev gcc pkg-config python3-dev python3-venv openssl"
# Peers that the tests hold our devices and our writing against; not needed for flying.
PEERS="aravis-tools-cli aravis-tools gpsd systemd strace libimage-exiftool-perl libnss3-tools iproute2"
# The virtual machine of `make test-v4l2`; if it cannot be installed that test reports it.
MACHINE="qemu-system-x86 busybox-static kmod v4l-utils"

missing() {
    for package in "$@"; do
        dpkg-query -W -f='${db:Status-Abbrev}' "$package" 2>/dev/null | grep -q '^ii' || printf '%s ' "$package"
    done
}

machine_only=${1:-}
case $machine_only in
    --machine) wanted=$(missing $MACHINE) ;;
    *) wanted=$(missing $PACKAGES $PEERS) ;;
esac
if [ -n "$wanted" ]; then
    if ! command -v apt-get >/dev/null; then
        echo "These system packages are missing, and there is no apt-get here: $wanted" >&2
        exit 1
    elif [ "$(id -u)" = 0 ]; then
        run=""
    elif command -v sudo >/dev/null && { sudo -n true 2>/dev/null || [ -t 0 ]; }; then
        run="sudo"
    else
        echo "System packages are missing. Run this as root, then make again:" >&2
        echo "    apt-get update && apt-get install -y --no-install-recommends $wanted" >&2
        [ "$machine_only" = --machine ] && exit 0
        exit 1
    fi
    echo "Installing system packages: $wanted"
    $run apt-get update -qq
    $run env DEBIAN_FRONTEND=noninteractive apt-get install -y -qq --no-install-recommends $wanted
fi
[ "$machine_only" = --machine ] && exit 0

"$PYTHON" -c 'import sys; sys.exit(sys.version_info < (3, 11))' || {
    echo "Python 3.11 or newer is needed; $PYTHON is $("$PYTHON" --version)" >&2
    exit 1
}
[ -x .venv/bin/python ] || "$PYTHON" -m venv .venv
echo "Installing Python packages into .venv (a few minutes the first time)"
.venv/bin/python -m pip install -q --disable-pip-version-check --require-hashes -r requirements.lock
.venv/bin/python -m pip install -q --disable-pip-version-check --no-deps --no-build-isolation -e .
echo "Ready: .venv/bin/syntopic --help"
