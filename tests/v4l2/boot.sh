#!/bin/sh
# Boot Debian's kernel in qemu and read its virtual camera, vivid, with the real source. The guest
# sees this machine's files read-only and runs the Python named. Usage: boot.sh PYTHON
set -eu
python=$1
work=$PWD/build/v4l2
skip() { echo "skipped: $1"; exit 0; }

test "$(uname -m)" = x86_64 || skip "it boots a kernel for x86_64"
command -v qemu-system-x86_64 >/dev/null || skip "no qemu (apt-get install qemu-system-x86)"
reason=$(sh tests/qemu_kernel.sh "$work" tests/v4l2/init virtio_pci 9pnet_virtio 9p vivid) ||
  skip "$reason"

# Software emulation: it runs everywhere, also where KVM is lacking or nested.
timeout 600 qemu-system-x86_64 -accel tcg -cpu max -smp 2 -m 2048 -no-reboot \
  -nic none -display none -monitor none -serial stdio \
  -kernel "$work/kernel" -initrd "$work/initramfs" \
  -append "console=ttyS0 quiet panic=-1 folder=$PWD python=$python" \
  -virtfs local,path=/,mount_tag=host,security_model=none,readonly=on,multidevs=remap \
  </dev/null | tee "$work/console.log"
grep -q "^guest: 0" "$work/console.log"
