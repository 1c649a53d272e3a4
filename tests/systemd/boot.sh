#!/bin/sh
# Install the service, boot systemd with it in qemu, and run tests/systemd/test_boot.py in there. The
# guest sees this machine's files beneath an overlay, the installed ones on top, and changes none.
# Usage: boot.sh PYTHON
set -eu
python=$1
work=$PWD/build/systemd
skip() { echo "skipped: $1"; exit 0; }

test "$(uname -m)" = x86_64 || skip "it boots a kernel for x86_64"
test "$(id -u)" = 0 || skip "the guest needs to read this machine's files as root does"
test -x /lib/systemd/systemd || skip "no systemd (apt-get install systemd)"
command -v qemu-system-x86_64 >/dev/null || skip "no qemu (apt-get install qemu-system-x86)"
# The unit hides homes, so a Python in one is no Python for it.
/usr/bin/python3 -c 'import ensurepip, sys; sys.exit(sys.version_info < (3, 11))' ||
  skip "no /usr/bin/python3 of 3.11 or newer with venv (apt-get install python3-venv)"
reason=$(sh tests/qemu_kernel.sh "$work/boot" tests/systemd/init \
  virtio_pci 9pnet_virtio 9p overlay vivid) || skip "$reason"

make --silent install DESTDIR="$work/root" PYTHON=/usr/bin/python3
"$python" -m tests.systemd.world "$work/world"

# Software emulation: it runs everywhere, also where KVM is lacking or nested.
timeout 1200 qemu-system-x86_64 -accel tcg,thread=multi -cpu max -smp 2 -m 3072 -no-reboot \
  -nic none -display none -monitor none -serial stdio \
  -kernel "$work/boot/kernel" -initrd "$work/boot/initramfs" \
  -append "console=ttyS0 quiet panic=-1 systemd.unit=trigpoint-test.service \
systemd.show_status=no fstab=no folder=$PWD python=$python" \
  -virtfs local,path=/,mount_tag=host,security_model=none,readonly=on,multidevs=remap \
  -virtfs local,path="$work/root",mount_tag=installed,security_model=none,readonly=on \
  </dev/null | tee "$work/console.log"
grep -q "^guest: 0" "$work/console.log"
