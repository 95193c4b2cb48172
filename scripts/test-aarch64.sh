#!/bin/sh
# Runs the kernel tests on emulated AArch64 CPUs: one with every extension, one with the byte dot product
# (Cortex-A76), one with base vectors only (Cortex-A53). The bits must equal those of x86-64: tests/kernels/hash.rs.
#
#   scripts/test-aarch64.sh [CPU...]       qemu CPU names; max cortex-a76 cortex-a53 by default
#
# Needs the Rust target   rustup target add aarch64-unknown-linux-gnu
#       the C linker      apt-get install gcc-aarch64-linux-gnu
#       the emulator      apt-get install qemu-user
# Native on an AArch64 machine: cargo test -p sf-ops, or scripts/test-isas.sh.
set -eu
cd "$(dirname "$0")/.."
[ $# -gt 0 ] || set -- max cortex-a76 cortex-a53

need() {
    command -v "$1" >/dev/null || { echo "$1 is missing: $2" >&2; exit 1; }
}
need aarch64-linux-gnu-gcc "apt-get install gcc-aarch64-linux-gnu"
need qemu-aarch64 "apt-get install qemu-user"
target=aarch64-unknown-linux-gnu
[ -d "$(rustc --print sysroot)/lib/rustlib/$target/lib" ] || {
    echo "the Rust target is missing: rustup target add $target" >&2
    exit 1
}

export CARGO_TARGET_AARCH64_UNKNOWN_LINUX_GNU_LINKER=aarch64-linux-gnu-gcc
for cpu in "$@"; do
    echo "== $cpu"
    export CARGO_TARGET_AARCH64_UNKNOWN_LINUX_GNU_RUNNER="qemu-aarch64 -cpu $cpu -L /usr/aarch64-linux-gnu"
    cargo run -q -p sf-ops --example kernels --target $target
    # Without the guard pages: a mapping for each allocation takes an emulator half an hour.
    cargo test -q -p sf-ops --lib --test kernels --test allocation --target $target
done
