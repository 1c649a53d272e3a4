#!/bin/sh
# Boot Debian's kernel in qemu and read its virtual camera, vivid, with the real source. The guest
# sees this machine's files read-only and runs the Python named. Usage: boot.sh PYTHON
set -eu
python=$1
work=$PWD/build/v4l2
skip() { echo "skipped: $1"; exit 0; }

test "$(uname -m)" = x86_64 || skip "it boots a kernel for x86_64"
command -v qemu-system-x86_64 >/dev/null || skip "no qemu (apt-get install qemu-system-x86)"
command -v apt-get >/dev/null || skip "it takes the kernel from Debian's packages"

if ! test -f "$work/kernel"; then
  rm -rf "$work" && mkdir -p "$work/root/bin"
  cd "$work"
  kernel=$(apt-cache depends linux-image-amd64 | sed -n 's/.*Depends: //p' | head -n 1)
  test -n "$kernel" || skip "no package linux-image-amd64 (apt-get update)"
  apt-get download -qq "$kernel" busybox-static 2>apt.log || skip "no kernel: $(tail -n 1 apt.log)"
  for package in *.deb; do dpkg-deb -x "$package" packages; done
  busybox=$work/packages/bin/busybox
  release=${kernel#linux-image-}
  "$busybox" depmod -b "$work/packages" "$release"
  modules=lib/modules/$release
  mkdir -p "root/$modules"
  cp "packages/$modules"/modules.* "root/$modules"
  for module in virtio_pci 9pnet_virtio 9p vivid; do
    grep "/$module\.ko:" "packages/$modules/modules.dep" | tr -d : | tr ' ' '\n'
  done | sort -u | while read -r file; do
    mkdir -p "root/$modules/$(dirname "$file")"
    cp "packages/$modules/$file" "root/$modules/$file"
  done
  cp "$busybox" root/bin
  cp packages/boot/vmlinuz-* kernel
  rm -rf packages ./*.deb
  cd - >/dev/null
fi
cp tests/v4l2/init "$work/root/init"
chmod +x "$work/root/init"
(cd "$work/root" && find . | ./bin/busybox cpio -o -H newc 2>/dev/null) >"$work/initramfs"

# Software emulation: it runs everywhere, also where KVM is lacking or nested.
timeout 600 qemu-system-x86_64 -accel tcg -cpu max -smp 2 -m 2048 -no-reboot \
  -nic none -display none -monitor none -serial stdio \
  -kernel "$work/kernel" -initrd "$work/initramfs" \
  -append "console=ttyS0 quiet panic=-1 folder=$PWD python=$python" \
  -virtfs local,path=/,mount_tag=host,security_model=none,readonly=on,multidevs=remap \
  </dev/null | tee "$work/console.log"
grep -q "^guest: 0" "$work/console.log"
