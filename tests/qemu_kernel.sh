#!/bin/sh
# Debian's kernel for qemu, in WORK/kernel and WORK/initramfs: busybox, the modules named and what
# they need, and the first process. Exit code 1 and the reason where there is none.
# Usage: qemu_kernel.sh WORK INIT MODULE...
set -eu
mkdir -p "$1" && work=$(cd "$1" && pwd)
init=$2
shift 2
fail() { echo "$1"; exit 1; }

if ! test -f "$work/kernel"; then
  rm -rf "$work/initramfs.d" && mkdir -p "$work/initramfs.d/bin"
  cd "$work"
  command -v apt-get >/dev/null || fail "the kernel is one of Debian's packages"
  kernel=$(apt-cache depends linux-image-amd64 | sed -n 's/.*Depends: //p' | head -n 1)
  test -n "$kernel" || fail "no package linux-image-amd64 (apt-get update)"
  apt-get download -qq "$kernel" busybox-static 2>apt.log || fail "no kernel: $(tail -n 1 apt.log)"
  for package in *.deb; do dpkg-deb -x "$package" packages; done
  packages/bin/busybox depmod -b packages "${kernel#linux-image-}"
  modules=lib/modules/${kernel#linux-image-}
  mkdir -p "initramfs.d/$modules"
  cp "packages/$modules"/modules.* "initramfs.d/$modules"
  for module in "$@"; do
    grep "/$module\.ko:" "packages/$modules/modules.dep" | tr -d : | tr ' ' '\n'
  done | sort -u | while read -r file; do
    mkdir -p "initramfs.d/$modules/$(dirname "$file")"
    cp "packages/$modules/$file" "initramfs.d/$modules/$file"
  done
  cp packages/bin/busybox initramfs.d/bin
  mv packages/boot/vmlinuz-* kernel
  rm -rf packages ./*.deb
  cd - >/dev/null
fi
install -m 755 "$init" "$work/initramfs.d/init"
(cd "$work/initramfs.d" && find . | bin/busybox cpio -o -H newc 2>/dev/null) >"$work/initramfs"
