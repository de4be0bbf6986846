#!/bin/sh
# What `make demo` and `make test` need before they start; quiet unless it goes wrong.
#   setup.sh venv PYTHON FOLDER      a virtual environment
#   setup.sh pip FOLDER REQUIREMENT  this project and its dependencies in it
#   setup.sh tools                   systemd's own checkers of units, users and temporary files; Pango, which sets PDF
set -eu

fail() { echo "swath: $*" >&2; exit 1; }

log=$(mktemp)
trap 'rm -f "$log"' EXIT

quietly() { # runs a command, shows its words only if it fails
    "$@" >"$log" 2>&1 </dev/null || { cat "$log" >&2; return 1; }
}

apt_install() {
    command -v apt-get >/dev/null || return 1
    quietly env DEBIAN_FRONTEND=noninteractive apt-get -q update || return 1
    quietly env DEBIAN_FRONTEND=noninteractive apt-get -q install -y --no-install-recommends "$@"
}

make_venv() {
    python=$1 folder=$2
    command -v "$python" >/dev/null || fail "$python does not exist; install Python 3.11 or newer, or set PYTHON=…"
    "$python" -c 'import sys; sys.exit(not (3, 11) <= sys.version_info < (3, 15))' ||
        fail "$python is $("$python" -V 2>&1); Python 3.11 to 3.14 is needed, set PYTHON=…"
    if ! "$python" -c 'import ensurepip, venv' 2>/dev/null; then
        version=$("$python" -c 'import sys; print("%d.%d" % sys.version_info[:2])')
        [ "$(id -u)" = 0 ] || fail "$python lacks its venv module: sudo apt-get install python$version-venv"
        echo "installing python$version-venv"
        apt_install "python$version-venv" || apt_install python3-venv ||
            fail "$python lacks its venv module, and apt-get could not install python$version-venv"
    fi
    echo "creating $folder with $("$python" -V 2>&1)"
    quietly "$python" -m venv "$folder" || { rm -rf "$folder"; fail "cannot create the virtual environment $folder"; }
}

pip_install() {
    echo "installing $2 into $1 (a minute or two the first time)"
    quietly "$1/bin/python" -m pip install -q -e "$2" || fail "pip could not install $2; see its output above"
}

check_tools() {
    missing=""
    for tool in systemd-analyze systemd-sysusers systemd-tmpfiles; do
        command -v "$tool" >/dev/null || missing="$missing $tool"
    done
    [ -n "$missing" ] || return 0
    [ "$(id -u)" = 0 ] || fail "the tests need$missing: sudo apt-get install systemd"
    echo "installing systemd's tools"
    apt_install systemd || fail "the tests need$missing, and apt-get could not install systemd"
}

check_pango() {
    packages="libpango-1.0-0 libpangoft2-1.0-0"
    ! PATH="$PATH:/sbin:/usr/sbin" ldconfig -p | grep -q 'libpangoft2-1\.0\.so\.0' || return 0
    [ "$(id -u)" = 0 ] || fail "the tests print PDF with Pango: sudo apt-get install $packages"
    echo "installing Pango"
    # shellcheck disable=SC2086
    apt_install $packages || fail "the tests print PDF with Pango, and apt-get could not install $packages"
}

case "${1-}" in
    venv) make_venv "$2" "$3" ;;
    pip) pip_install "$2" "$3" ;;
    tools) check_tools && check_pango ;;
    *) fail "use: setup.sh venv PYTHON FOLDER | pip FOLDER REQUIREMENT | tools" ;;
esac
