#!/bin/sh
# Installs what Syntopic needs on a fresh Debian or Ubuntu machine, in five steps: system packages
# through apt (as root, or with sudo; otherwise the exact line is printed), a virtual environment,
# locked Python packages, Syntopic itself, compiled kernels (`make .venv/kernels` runs that step).
#   bootstrap.sh            what flying needs
#   bootstrap.sh --tests    system packages that the tests need in addition
#   bootstrap.sh --machine  system packages of the virtual machine of `make test-v4l2`
set -eu
cd "$(dirname "$0")"

PYTHON=${PYTHON:-python3}
# Heads: Aravis and its typelib. Building PyGObject: compiler, headers. Debian packages venv apart.
# Certificates: openssl.
PACKAGES="gir1.2-aravis-0.8 libgirepository1.0-dev libcairo2-dev gcc pkg-config python3-dev
    python3-venv openssl"
# Programs that the tests compare our devices, pages and files with, and programs that inject faults.
TESTS="aravis-tools-cli aravis-tools gpsd systemd strace libimage-exiftool-perl rtklib libnss3-tools
    iproute2 linuxptp hugin-tools enblend e2fsprogs procps groff-base"
# The virtual machine of `make test-v4l2`; if it cannot be installed that test reports it.
MACHINE="qemu-system-x86 busybox-static kmod v4l-utils"
LOG=build/setup.log

missing() {
    for package in "$@"; do
        dpkg-query -W -f='${db:Status-Abbrev}' "$package" 2>/dev/null | grep -q '^ii' ||
            printf '%s ' "$package"
    done
}

# A browser and npm also come from elsewhere: a command that exists is not installed again.
missing_command() {
    command -v "$1" >/dev/null || printf '%s ' "$1"
}

# Time left by the share that is done: "about 40 s left".
time_left() { # seconds-spent done all
    [ "$2" -gt 0 ] && [ "$3" -gt "$2" ] && echo ", about $(($1 * ($3 - $2) / $2)) s left"
}

# Runs a command with its output in the log. On a terminal the line is renewed each second.
step() { # label title cure count-function all command...
    label=$1 title=$2 cure=$3 count=$4 all=$5
    shift 5
    began=$(date +%s)
    echo "== [$label] $title: $*" >>"$LOG"
    "$@" >>"$LOG" 2>&1 </dev/null &
    command=$!
    trap 'kill $command 2>/dev/null; echo; echo "Interrupted: run make setup again."; exit 130' INT
    [ -t 1 ] || echo "[$label] $title ..."
    while kill -0 $command 2>/dev/null; do
        spent=$(($(date +%s) - began))
        [ -t 1 ] && printf '\r\033[K[%s] %s: %s s%s' \
            "$label" "$title" "$spent" "$(time_left $spent "$($count)" "$all")"
        sleep 1
    done
    status=0
    wait $command || status=$?
    trap - INT
    [ -t 1 ] && printf '\r\033[K'
    if [ "$status" != 0 ]; then
        echo "[$label] $title failed with status $status. The end of $LOG:" >&2
        tail -n 15 "$LOG" | sed 's/^/    /' >&2
        echo "$cure Then run make setup again." >&2
        exit 1
    fi
    echo "[$label] $title: done in $(($(date +%s) - began)) s"
}

nothing() { echo 0; }
# A package counts when it is collected, and when it is installed.
packages() {
    collected=$(grep -cE '^(Collecting|Requirement already)' "$LOG" || true)
    installed=$(ls -d .venv/lib/python3*/site-packages/*.dist-info 2>/dev/null | wc -l)
    echo $((collected + installed))
}

install_system_packages() {
    if ! command -v apt-get >/dev/null; then
        echo "System packages are missing, and this machine has no apt-get: $wanted" >&2
        exit 1
    elif [ "$(id -u)" = 0 ]; then
        run=""
    elif command -v sudo >/dev/null && { sudo -n true 2>/dev/null || { [ -t 0 ] && sudo true; }; }
    then
        run="sudo"
    else
        echo "System packages are missing. Run this as root, then make again:" >&2
        echo "    apt-get update && apt-get install -y --no-install-recommends $wanted" >&2
        [ "$only" = --machine ] && exit 0
        exit 1
    fi
    # One of several that run next to each other.
    step "$label" "System packages" "Check the network and the apt sources." nothing 0 \
        flock build/apt.lock sh -c "
        $run apt-get update -qq &&
        $run env DEBIAN_FRONTEND=noninteractive \
            apt-get install -y -qq --no-install-recommends $wanted"
}

mkdir -p build
: >"$LOG"
only=${1:-}
label=${only:+${only#--}}
label=${label:-1/5}
case $only in
    --machine) wanted=$(missing $MACHINE) ;;
    --tests)
        wanted=$(missing $TESTS && missing_command npm)
        # Ubuntu has no such package, only a snap; tests with a browser are skipped there.
        grep -q '^ID=ubuntu' /etc/os-release || wanted="$wanted$(missing_command chromium)"
        ;;
    *) wanted=$(missing $PACKAGES) ;;
esac
if [ -n "$wanted" ]; then
    install_system_packages
else
    echo "[$label] System packages: present"
fi
[ -n "$only" ] && exit 0

"$PYTHON" -c 'import sys; sys.exit(sys.version_info < (3, 11))' || {
    echo "Python 3.11 or newer is needed; $PYTHON is $("$PYTHON" --version)" >&2
    exit 1
}
if [ -x .venv/bin/python ]; then
    echo "[2/5] Virtual environment: present"
else
    step 2/5 "Virtual environment" "Remove .venv." nothing 0 "$PYTHON" -m venv .venv
fi
locked=$(grep -cE '^[a-z0-9].*==' requirements.lock)
export PIP_DISABLE_PIP_VERSION_CHECK=1 PIP_NO_INPUT=1 PIP_PROGRESS_BAR=off
step 3/5 "Python packages" "Check the network, the package index and the free disk space." \
    packages $((2 * locked)) \
    .venv/bin/python -m pip install --require-hashes -r requirements.lock
step 4/5 "Syntopic itself" "Remove .venv." nothing 0 \
    .venv/bin/python -m pip install --no-deps --no-build-isolation -e .
