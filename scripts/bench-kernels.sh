#!/bin/sh
# Times the kernels of this CPU and prints the table of docs/kernels.md as Markdown. Every layer is checked against its
# definition first; the peak is probed in the same run by the same number of threads.
#
#   scripts/bench-kernels.sh [FILTER]      layers whose name holds FILTER; all by default
#
# STREETFORWARD_THREADS=2 uses two threads, STREETFORWARD_BENCH=all times every kernel set of this CPU. Wants an idle machine:
# the line in front of the table says what else ran.
set -eu
cd "$(dirname "$0")/.."
cargo build -q --manifest-path bench/Cargo.toml --benches --profile bench
grep -m 1 "model name" /proc/cpuinfo 2>/dev/null | sed 's/.*: /CPU: /' || true
[ ! -r /proc/loadavg ] || echo "load before: $(cut -d' ' -f1-3 /proc/loadavg); threads: ${STREETFORWARD_THREADS:-1}"
cargo bench -q --manifest-path bench/Cargo.toml --bench kernels -- --noplot "$@" 2>/dev/null | sed -n '/^| /p; /^|--/p'
