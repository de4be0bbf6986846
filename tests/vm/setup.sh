#!/bin/bash
# What the tests in a virtual machine need: packages, Debian's kernel (unpacked, never installed), an initramfs, the
# modules of a simulated PPS and CAN controller, udev for the machine. All of it lies in .cache beside this file; done again only when asked
# for something new.
set -euo pipefail
here=$(cd "$(dirname "$0")" && pwd)
cache=$here/.cache
packages=(qemu-system-x86 busybox-static cpio kmod iproute2 systemd e2fsprogs gcc-12 make xz-utils bc python3-venv)
modules=(pps_sim can_sim)

fail() { echo "swath: $*" >&2; exit 1; }
download() { (mkdir -p "$1" && cd "$1" && shift && apt-get -qq -o APT::Sandbox::User=root download "$@"); }

install_packages() {
    dpkg -s "${packages[@]}" >/dev/null 2>&1 && return
    [ "$(id -u)" = 0 ] || fail "sudo apt-get install ${packages[*]}"
    echo "installing qemu and what goes with it"
    apt-get -qq update
    DEBIAN_FRONTEND=noninteractive apt-get -qq install -y --no-install-recommends "${packages[@]}" >/dev/null
}

# Debian drops old builds of a kernel: whichever linux-image-amd64 depends on today, once there is none.
fetch_kernel() {
    [ ! -e "$cache/kernel/boot/vmlinux" ] || return 0
    name=$(apt-cache depends linux-image-amd64 | awk '/Depends: linux-image-[0-9]/{print $2; exit}')
    [ -n "$name" ] || { apt-get -qq update; name=$(apt-cache depends linux-image-amd64 | awk '/Depends: linux-image-[0-9]/{print $2; exit}'); }
    [ -n "$name" ] || fail "apt knows no linux-image-amd64"
    echo "fetching $name"
    rm -rf "$cache/kernel" "$cache/kernel.part"
    download "$cache/kernel.part/deb" "$name"
    dpkg -x "$cache"/kernel.part/deb/*.deb "$cache/kernel.part"
    rm -r "$cache/kernel.part/deb"
    depmod -b "$cache/kernel.part" "$(ls "$cache/kernel.part/lib/modules")"
    uncompress "$cache"/kernel.part/boot/vmlinuz-* "$cache/kernel.part/boot/vmlinux"
    mv "$cache/kernel.part" "$cache/kernel"
}

# The uncompressed kernel starts by PVH, which saves seconds where the processor is emulated.
uncompress() {
    python3 - "$1" "$2" <<'PY'
import lzma
import struct
import sys

image = open(sys.argv[1], "rb").read()
offset = (image[0x1F1] + 1) * 512 + struct.unpack_from("<I", image, 0x248)[0]
kernel = lzma.LZMADecompressor().decompress(image[offset : offset + struct.unpack_from("<I", image, 0x24C)[0]])
assert kernel[:4] == b"\x7fELF", "not a kernel compressed by xz"
open(sys.argv[2], "wb").write(kernel)
PY
}

build_modules() {
    stale=
    for name in "${modules[@]}"; do
        module=$cache/modules/$name.ko
        [ "$module" -nt "$here/guest/$name.c" ] && [ "$module" -nt "$cache/kernel/boot/vmlinux" ] || stale=1
    done
    [ -n "$stale" ] || return 0
    release=$(ls "$cache/kernel/lib/modules")
    headers=$cache/headers
    echo "building ${modules[*]} for $release"
    rm -rf "$headers" "$cache/modules"
    download "$headers/deb" "linux-headers-$release" "linux-headers-${release%-*}-common" "linux-kbuild-$(echo "$release" | cut -d. -f1,2)"
    for package in "$headers"/deb/*.deb; do dpkg -x "$package" "$headers"; done
    rm -r "$headers/deb"
    sed -i "s#/usr/src/#$headers/usr/src/#" "$headers/usr/src/linux-headers-$release/Makefile"
    mkdir -p "$cache/modules"
    for name in "${modules[@]}"; do
        cp "$here/guest/$name.c" "$cache/modules/"
        echo "obj-m += $name.o" >>"$cache/modules/Makefile"
    done
    make -s -C "$headers/usr/src/linux-headers-$release" M="$cache/modules" modules
}

make_initramfs() {
    [ "$cache/initramfs.gz" -nt "$here/guest/init" ] && [ "$cache/initramfs.gz" -nt "$cache/kernel/boot/vmlinux" ] && return
    release=$(ls "$cache/kernel/lib/modules")
    root=$(mktemp -d)
    mkdir -p "$root"/{bin,proc,sys,dev,ro,rw,root,"lib/modules/$release"}
    cp "$(command -v busybox)" "$root/bin/busybox"
    install -m 755 "$here/guest/init" "$root/init"
    for module in virtio_pci 9pnet_virtio 9p overlay virtio_blk crc32c_generic ext4; do
        modprobe -d "$cache/kernel" -S "$release" --show-depends "$module" | awk '$1 == "insmod" {print $2}'
    done | sort -u | while read -r file; do
        install -D "$file" "$root/${file#"$cache/kernel/"}"
    done
    cp "$cache/kernel/lib/modules/$release"/modules.{order,builtin} "$root/lib/modules/$release/"
    depmod -b "$root" "$release" 2>/dev/null
    (cd "$root" && find . | cpio -o -H newc --quiet | gzip -1) >"$cache/initramfs.gz"
    rm -r "$root"
}

# A folder to lay over the machine's root; bin, sbin and lib are links there.
fetch_udev() {
    [ ! -e "$cache/udev/usr/bin/udevadm" ] || return 0
    echo "fetching udev"
    rm -rf "$cache/udev" "$cache/udev.part"
    download "$cache/udev.part/deb" udev
    dpkg -x "$cache"/udev.part/deb/*.deb "$cache/udev.part"
    rm -r "$cache/udev.part/deb"
    for folder in bin sbin lib; do
        [ -d "$cache/udev.part/$folder" ] || continue
        mkdir -p "$cache/udev.part/usr/$folder"
        cp -a "$cache/udev.part/$folder/." "$cache/udev.part/usr/$folder/"
        rm -r "$cache/udev.part/$folder"
    done
    mv "$cache/udev.part" "$cache/udev"
}

build_shims() {
    for name in dcd_shim:"$here" nosync:"$here/guest"; do
        source=${name#*:}/${name%%:*}.c library=$cache/${name%%:*}.so
        [ "$library" -nt "$source" ] || gcc-12 -shared -fPIC -O2 -o "$library" "$source" -ldl
    done
}

[ "$(uname -m)" = x86_64 ] || fail "the virtual machine is an x86-64 one, this computer is $(uname -m)"
install_packages
mkdir -p "$cache"
fetch_kernel
build_modules
make_initramfs
fetch_udev
build_shims
