#!/bin/sh
# Installs the recorder on an aircraft's computer, or removes it.   install.sh install|files|uninstall
#   (files: all but the program, for who builds that by other means)
#   PREFIX   where the program goes, /opt/swath by default; the unit's paths follow
#   DESTDIR  a root to install into, for packagers: nothing is then started, created or loaded
#   PYTHON   the system's Python 3.11 or newer; not one in a home directory, which the service cannot see
#   EXTRAS   what goes with it beside recording, process,live,console by default (swath live, georef, console); empty: nothing
set -eu

DESTDIR=${DESTDIR-}
PREFIX=${PREFIX:-/opt/swath}
PREFIX=${PREFIX%/}
PYTHON=${PYTHON:-/usr/bin/python3}
EXTRAS=${EXTRAS-process,live,console}
cache=/var/cache/swath-live
source=$(cd "$(dirname "$0")/.." && pwd)

program=$DESTDIR$PREFIX
building=$program.building # beside it: on the same disk, so that a rename puts it in place

fail() { echo "swath: $*" >&2; exit 1; }
case $PREFIX in /?*) ;; *) fail "PREFIX must be the absolute path of a folder for swath alone, such as /opt/swath" ;; esac

# file in this folder -> place on the computer; uninstall removes exactly these
placed() {
    cat <<LIST
swathd.service /usr/lib/systemd/system/swathd.service
swathd@.service /usr/lib/systemd/system/swathd@.service
swath-live.service /usr/lib/systemd/system/swath-live.service
swath-console.service /usr/lib/systemd/system/swath-console.service
swath-pps@.service /usr/lib/systemd/system/swath-pps@.service
sysctl/90-swath.conf /usr/lib/sysctl.d/90-swath.conf
network/80-swath-can.network /usr/lib/systemd/network/80-swath-can.network
udev/90-swath.rules /usr/lib/udev/rules.d/90-swath.rules
tmpfiles/swath.conf /usr/lib/tmpfiles.d/swath.conf
sysusers/swath.conf /usr/lib/sysusers.d/swath.conf
chrony/swath.conf /etc/chrony/conf.d/swath.conf
LIST
}

on_this_computer() { [ -z "$DESTDIR" ] && [ -d /run/systemd/system ]; }

check_python() {
    [ "$(id -u)" = 0 ] || [ -n "$DESTDIR" ] || fail "make install needs root: sudo make install"
    "$PYTHON" -c 'import sys; sys.exit(not (3, 11) <= sys.version_info < (3, 15))' 2>/dev/null ||
        fail "$PYTHON is not Python 3.11 to 3.14; set PYTHON=…"
    "$PYTHON" -c 'import ensurepip, venv' 2>/dev/null || fail "$PYTHON lacks its venv module: apt-get install python3-venv"
    case $(readlink -f "$(command -v "$PYTHON")") in
        /root/* | /home/*) fail "$PYTHON is in a home directory, which the service cannot read; set PYTHON=/usr/bin/python3" ;;
    esac
}

# Also when it fails or is interrupted: the program that was there is in its place.
leave_whole() {
    [ -e "$program" ] || [ ! -e "$program.old" ] || mv "$program.old" "$program"
    rm -rf "$work" "$building"
}

# The project is copied before it is built, so that nothing is left in the source tree. The program that is there stays
# until the other one is whole, so that the aircraft is never without one.
install_program() {
    echo "installing the program into $program"
    if [ -d "$program" ] && [ ! -e "$program/pyvenv.cfg" ] && [ -n "$(ls -A "$program")" ]; then
        fail "$program holds other files; set PREFIX to a folder for swath alone, such as /opt/swath"
    fi
    work=$(mktemp -d)
    trap leave_whole EXIT
    trap 'exit 129' HUP
    trap 'exit 130' INT
    trap 'exit 143' TERM
    mkdir "$work/swath"
    for item in pyproject.toml README.md LICENSE swath calib daemon drivers georef sim; do
        cp -R "$source/$item" "$work/swath/"
    done
    build_program
    put_in_place
}

build_program() {
    rm -rf "$building"
    mkdir -p "$building"
    chmod 0755 "$building"
    {
        "$PYTHON" -m venv "$building" --prompt swath &&
            PIP_DISABLE_PIP_VERSION_CHECK=1 PIP_ROOT_USER_ACTION=ignore \
                "$building/bin/python" -m pip install -q "$work/swath${EXTRAS:+[$EXTRAS]}"
    } >"$work/log" 2>&1 </dev/null || {
        cat "$work/log" >&2
        [ ! -e "$program/pyvenv.cfg" ] || echo "swath: the program in $program is unchanged" >&2
        fail "the program could not be installed; see the output of pip above"
    }
    # its scripts must name the place where they will be
    grep -rlIF "$building" "$building/bin" "$building/pyvenv.cfg" | while read -r file; do
        [ -L "$file" ] || sed -i "s#$building#$PREFIX#g" "$file"
    done
    documents="$building/share/doc/swath"
    mkdir -p "$documents"
    cp -R "$source/README.md" "$source/LICENSE" "$source/CHANGELOG.md" "$source/docs" "$documents/"
    mkdir -p "$documents/fixtures/config"
    cp "$source/fixtures/config/aircraft.toml" "$documents/fixtures/config/"
}

put_in_place() {
    rm -rf "$program.old"
    [ -n "$DESTDIR" ] || sync -f "$building" # a power cut must not find half of it on the disk
    [ ! -d "$program" ] || mv "$program" "$program.old"
    mv "$building" "$program"
    name_other_drivers
    rm -rf "$program.old"
}

# They were installed beside the old program, from somewhere that only the administrator knows.
name_other_drivers() {
    for file in "$program.old"/lib/python3*/site-packages/*.dist-info/entry_points.txt; do
        if grep -q '^\[swath\.drivers\]' "$file" 2>/dev/null; then
            echo "the drivers of $(basename "${file%.dist-info/*}") were beside the old program; install that package again," \
                "with $PREFIX/bin/pip, before the next recording"
        fi
    done
}

# What stands in /etc is the administrator's to change: it is not overwritten without a trace.
keep_changed() {
    case $2 in /etc/*) ;; *) return 0 ;; esac
    [ -e "$DESTDIR$2" ] && ! cmp -s "$source/systemd/$1" "$DESTDIR$2" || return 0
    kept=$DESTDIR$2.old more=1
    while [ -e "$kept" ] && ! cmp -s "$DESTDIR$2" "$kept"; do # what an earlier install kept stays, too
        more=$((more + 1)) kept=$DESTDIR$2.old$more
    done
    cp -p "$DESTDIR$2" "$kept"
    echo "replaced $DESTDIR$2; the previous file is $kept"
}

install_files() {
    placed | while read -r from to; do
        mkdir -p "$DESTDIR$(dirname "$to")"
        keep_changed "$from" "$to"
        sed "s#/opt/swath#$PREFIX#g" "$source/systemd/$from" >"$DESTDIR$to"
        chmod 0644 "$DESTDIR$to"
    done
    mkdir -p "$DESTDIR/etc/swath" "$DESTDIR/usr/local/bin"
    ln -sfn "$PREFIX/bin/swath" "$DESTDIR/usr/local/bin/swath"
    if [ -e "$DESTDIR/etc/swath/swath.toml" ] || [ -L "$DESTDIR/etc/swath/swath.toml" ]; then # a link's disk may be away
        echo "kept $DESTDIR/etc/swath/swath.toml"
    else
        install -m 0644 "$source/systemd/swath.toml" "$DESTDIR/etc/swath/swath.toml"
        echo "example configuration: $DESTDIR/etc/swath/swath.toml"
    fi
}

activate() {
    systemd-sysusers
    systemd-tmpfiles --create "$1"
    sysctl -q -p "$2"
    systemctl daemon-reload
    if command -v udevadm >/dev/null; then # devices that are there get their names and rights now
        udevadm control --reload && udevadm trigger --subsystem-match=pps --subsystem-match=tty ||
            echo "udev is not running; its rules take effect at the next start"
    fi
    echo "next: edit /etc/swath/swath.toml, then run swath check /etc/swath/swath.toml && systemctl enable --now swathd"
}

tell_what_runs() {
    ! systemctl is-active --quiet swathd ||
        echo "swathd still runs the previous program; when no recording is running: systemctl restart swathd"
}

# What swath-live.service needs compiled, into the cache that it uses; without, it does this when it first starts.
warm_up() {
    [ -z "$DESTDIR" ] && [ -n "$EXTRAS" ] || return 0
    echo "compiling, a minute or two the first time"
    mkdir -p -m 0750 "$cache"
    NUMBA_CACHE_DIR="$cache" "$PREFIX/bin/swath" warm-up ||
        echo "swath warm-up failed, see its output above; recording does not need it"
    ! id swath >/dev/null 2>&1 || chown -R swath:swath "$cache"
}

install_all() {
    check_python
    install_program
    install_files
    if on_this_computer; then
        activate /usr/lib/tmpfiles.d/swath.conf /usr/lib/sysctl.d/90-swath.conf
        warm_up
        echo "for points during a recording: systemctl enable --now swath-live"
        tell_what_runs
    else
        warm_up
        echo "installed; users, directories and kernel settings take effect at the next start of systemd"
    fi
}

uninstall_all() {
    [ "$(id -u)" = 0 ] || [ -n "$DESTDIR" ] || fail "make uninstall needs root: sudo make uninstall"
    if on_this_computer; then
        systemctl disable --now swath-live.service swathd.service 2>/dev/null || true
        systemctl stop 'swathd@*.service' 'swath-pps@*.service' 2>/dev/null || true
    fi
    placed | while read -r _ to; do
        rm -f "$DESTDIR$to"
    done
    [ "$(readlink "$DESTDIR/usr/local/bin/swath" || true)" != "$PREFIX/bin/swath" ] || rm -f "$DESTDIR/usr/local/bin/swath"
    [ ! -e "$program/pyvenv.cfg" ] || rm -rf "$program"
    rm -rf "$DESTDIR$cache" "$building" "$program.old"
    if on_this_computer; then
        systemctl daemon-reload
    fi
    echo "removed; kept: $DESTDIR/etc/swath (configuration), $DESTDIR/var/lib/swath (logs), the user swath"
}

case "${1-}" in
    install) install_all ;;
    files) install_files ;;
    uninstall) uninstall_all ;;
    *) fail "usage: install.sh install|files|uninstall" ;;
esac
