#!/bin/bash
# What the tests on ARM64 need: an emulated processor, Debian's Python for it, the wheels of its libraries in the versions
# that the host's virtual environment has. Nothing is installed but qemu; the rest lies in .cache beside this file.
#   setup.sh VENV
set -euo pipefail
here=$(cd "$(dirname "$0")" && pwd)
tree=$(cd "$here/../.." && pwd)
cache=$here/.cache
host=${1:?use: setup.sh VENV}/bin/python
processor=cortex-a72  # of many an aircraft's computer, and without what its successors have

fail() { echo "swath: $*" >&2; exit 1; }

install_qemu() {
    command -v qemu-aarch64 >/dev/null && return
    [ "$(id -u)" = 0 ] || fail "sudo apt-get install qemu-user"
    echo "installing qemu"
    apt-get -qq update
    DEBIAN_FRONTEND=noninteractive apt-get -qq install -y --no-install-recommends qemu-user >/dev/null
}

# apt as this computer has it set up, for another architecture and with nothing installed
arm64_apt() {
    apt-get -qq -o APT::Architecture=arm64 -o APT::Architectures::=arm64 -o APT::Sandbox::User=root \
        -o Dir::State="$cache/apt" -o Dir::State::status="$cache/apt/status" -o Dir::Cache="$cache/apt" "$@"
}

fetch_python() {
    [ ! -e "$cache/root/usr/bin/python3" ] || return 0
    echo "fetching Python for ARM64"
    rm -rf "$cache/apt" "$cache/root" "$cache/root.part"
    mkdir -p "$cache/apt/lists/partial" "$cache/apt/archives/partial" "$cache/root.part"
    : >"$cache/apt/status"
    arm64_apt update
    arm64_apt install -y --no-install-recommends --download-only python3 libstdc++6 libgomp1 libexpat1 >/dev/null
    for package in "$cache"/apt/archives/*.deb; do dpkg -x "$package" "$cache/root.part"; done
    rm -r "$cache/apt"
    mv "$cache/root.part" "$cache/root"
}

# pip runs here and installs for there: emulated it would take a quarter of an hour
install_wheels() {
    requirements >"$cache/requirements.new"
    "$host" -m pip freeze --exclude-editable --exclude swath >"$cache/versions.new"
    cmp -s "$cache/requirements.new" "$cache/requirements" && cmp -s "$cache/versions.new" "$cache/versions" && return
    echo "installing the wheels for ARM64"
    rm -rf "$site" "$cache/requirements" "$cache/numba"
    platforms=()
    for glibc in 2_17 2_24 2_26 2_27 2_28 2_31 2_34 2_35 2_36; do platforms+=(--platform "manylinux_${glibc}_aarch64"); done
    "$host" -m pip install -q --target "$site" --no-compile --implementation cp --python-version "$version" \
        "${platforms[@]}" --platform manylinux2014_aarch64 --only-binary=:all: \
        -r "$cache/requirements.new" -c "$cache/versions.new"
    mv "$cache/versions.new" "$cache/versions"
    mv "$cache/requirements.new" "$cache/requirements"
}

requirements() {
    "$host" - "$tree/pyproject.toml" <<'PY'
import sys
import tomllib

project = tomllib.load(open(sys.argv[1], "rb"))["project"]
print(*project["dependencies"], *project["optional-dependencies"]["test"], sep="\n")
PY
}

# Processes of other programs see the host's files; Python finds its own by where it lies, and itself as this script, so
# that what a test starts is emulated too. No root is changed to, nothing is registered with the kernel.
write_starter() {
    mkdir -p "$venv/bin"
    printf 'home = %s\ninclude-system-site-packages = false\n' "$cache/root/usr/bin" >"$venv/pyvenv.cfg"
    cat >"$venv/bin/python" <<END
#!/bin/sh
export NUMBA_CACHE_DIR="\${NUMBA_CACHE_DIR:-$cache/numba}"
exec qemu-aarch64 -cpu $processor -L "$cache/root" -0 "\$0" "$cache/root/usr/bin/python$version" "\$@"
END
    chmod +x "$venv/bin/python"
    for script in "$site"/bin/*; do
        [ "$(head -c 2 "$script")" = "#!" ] || continue
        sed "1s|.*|#!$venv/bin/python|" "$script" >"$venv/bin/${script##*/}"
        chmod +x "$venv/bin/${script##*/}"
    done
    rm -rf "$site"/swath-*.dist-info
    cp -r "$("$host" -c 'import sysconfig; print(sysconfig.get_path("purelib"))')"/swath-*.dist-info "$site/"
}

[ "$(uname -m)" != aarch64 ] || fail "this computer is an ARM64 one: make test"
install_qemu
mkdir -p "$cache"
fetch_python
version=$(cd "$cache/root/usr/bin" && readlink python3 | sed s/python//)
mine=$("$host" -c 'import sys; print("%d.%d" % sys.version_info[:2])')
[ "$version" = "$mine" ] || fail "Debian's Python is $version, this is $mine: make test-arm64 PYTHON=python$version VENV=.venv-$version"
venv=$cache/venv site=$cache/venv/lib/python$version/site-packages
install_wheels
write_starter
