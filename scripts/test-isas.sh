#!/bin/sh
# Runs the kernel tests once for every instruction set of this CPU, with STREETFORWARD_CPU as the cap, so that what
# `Kernels::best` chooses is tested for each of them and not only for the strongest.
#
#   scripts/test-isas.sh [CRATE...]        crates to test; sf-ops alone by default
#
# Names that this CPU does not have are reported as not run. Fails when a test fails, or when scalar did not run.
set -eu
cd "$(dirname "$0")/.."
[ $# -gt 0 ] || set -- sf-ops
crates=
for crate in "$@"; do crates="$crates -p $crate"; done

case $(uname -m) in
x86_64) names="scalar avx2 avxvnni avx512 avx512vnni" ;;
aarch64) names="scalar neon neondot" ;;
*) names=scalar ;;
esac

# Built once; the variable is read when a test starts.
# shellcheck disable=SC2086
cargo test -q $crates --no-run
ran= missing=
for name in $names; do
    # The probe prints the kernels under the cap, or one line why there are none.
    if ! why=$(STREETFORWARD_CPU=$name cargo run -q -p sf-ops --example kernels 2>&1); then
        echo "not run: $name ($why)"
        missing="$missing $name"
        continue
    fi
    echo "== $why"
    # shellcheck disable=SC2086
    STREETFORWARD_CPU=$name cargo test -q $crates
    ran="$ran $name"
done
echo "ran:$ran; not run:${missing:- none}"
case $ran in *scalar*) ;; *) echo "scalar did not run" >&2; exit 1 ;; esac
