#!/bin/sh
# Runs the kernel tests and `streetforward doctor` on an emulated x86-64 CPU without AVX (Nehalem, 2008), on which any vector
# instruction beyond SSE4.2 faults. So it shows that nothing of the kind runs before the CPU was asked, and that the portable
# kernels are chosen and give the bits of the others: tests/kernels/hash.rs.
#
#   scripts/test-old-cpu.sh [CPU...]       qemu CPU names; Nehalem by default (also tried: core2duo)
#
# Needs the emulator      apt-get install qemu-user
# Takes some ten minutes: portable kernels, emulated. SF_OLD_CPU_TESTS names the kernel tests to run (all by default).
set -eu
cd "$(dirname "$0")/.."
[ $# -gt 0 ] || set -- Nehalem
command -v qemu-x86_64 >/dev/null || { echo "qemu-x86_64 is missing: apt-get install qemu-user" >&2; exit 1; }

work=$(mktemp -d)
trap 'rm -rf "$work"' EXIT
# The emulator must refuse AVX on this CPU, otherwise a pass would say nothing.
echo 'fn main() { unsafe { std::arch::asm!("vxorps ymm0, ymm0, ymm0") } }' >"$work/avx.rs"
rustc -o "$work/avx" "$work/avx.rs"

# Paths of the test programs and of the command line; built for this machine as always.
cargo test -q -p sf-ops --no-run --message-format=json 2>/dev/null |
    sed -n 's/.*"kind":\["\(test\|lib\)"\].*"executable":"\([^"]*\)".*/\2/p' >"$work/tests"
cargo build -q -p streetforward-cli
for cpu in "$@"; do
    if qemu-x86_64 -cpu "$cpu" "$work/avx" 2>/dev/null; then
        echo "qemu runs AVX instructions on $cpu: choose an older CPU or a newer qemu" >&2
        exit 1
    fi
    echo "== $cpu"
    while read -r test; do
        case $test in
        # Disassembles; runs nothing of interest here.
        */codegen-*) continue ;;
        esac
        echo "-- ${test##*/}"
        # shellcheck disable=SC2086
        case $test in
        */kernels-*) qemu-x86_64 -cpu "$cpu" "$test" -q ${SF_OLD_CPU_TESTS:-} ;;
        *) qemu-x86_64 -cpu "$cpu" "$test" -q ;;
        esac
    done <"$work/tests"
    qemu-x86_64 -cpu "$cpu" target/debug/streetforward doctor
done
