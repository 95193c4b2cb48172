#!/bin/sh
# One answer everywhere: the trained network (f16 and int8) on three generated streets and in the golden run inside each blob,
# on every instruction set of this CPU, on 1, 2, 3 and 8 threads, again and again, and on emulated AArch64 CPUs.
#
#   scripts/test-one-hash.sh [MODEL]       checkpoint to convert; models/nano/nano.safetensors by default
#
# SF_REPEATS   runs of every golden clip and number of threads, default 5
# SF_AARCH64   qemu CPU names, "max cortex-a53" by default (dot product; base vectors only); empty: none. Needs what
#              scripts/test-aarch64.sh needs.
# Prints each digest with everything that gave it. Fails when two differ, when conversion is not byte for byte the same on
# the emulated CPU, or when scalar did not run.
set -eu
cd "$(dirname "$0")/.."
checkpoint=${1:-models/nano/nano.safetensors}
repeats=${SF_REPEATS:-5}
work=$(mktemp -d)
trap 'rm -rf "$work"' EXIT

cargo build -q -p streetforward-cli
native=${CARGO_TARGET_DIR:-target}/debug/streetforward
case $(uname -m) in
x86_64) names="scalar avx2 avxvnni avx512 avx512vnni" ;;
aarch64) names="scalar neon neondot" ;;
*) names=scalar ;;
esac
for precision in f16 int8; do
    "$native" convert -q "$checkpoint" --to $precision -o "$work/$precision.sfw" >/dev/null
done
# Three seeds of the held-out split. Four frames half a second apart, two, and one.
for seed in 7 101 105; do
    "$native" synth -q --seed $seed --frames 20 --size 168x112 -o "$work/clip$seed" >/dev/null
done

faults=$work/faults
: >"$faults"
# note PRECISION CLIP DIGEST WHERE: remembers the first digest of a clip and compares the others with it.
note() {
    known=$work/$1-$2.digest
    if [ -z "$3" ]; then
        echo "$1 $2 on $4: no result" | tee -a "$faults"
    elif [ ! -f "$known" ]; then
        echo "$3" >"$known"
        echo "$1 $2: $3"
    elif [ "$(cat "$known")" != "$3" ]; then
        echo "$1 $2 on $4: $3" | tee -a "$faults"
    fi
    echo x >>"$work/count"
}
digest() { sed -n "s/.*\"$1\": \"\([0-9a-f]\{64\}\)\".*/\1/p"; }
# clip PRECISION SEED FRAMES ISA THREADS PROGRAM...
clip() {
    precision=$1 seed=$2 frames=$3 isa=$4 threads=$5
    shift 5
    rm -rf "$work/out"
    found=$("$@" run -q -m "$work/$precision.sfw" -i "$work/clip$seed" --frames "$frames" --isa "$isa" --threads "$threads" \
        --emit poses -o "$work/out" --json | digest output_digest) || found=
    note "$precision" "street-$seed" "$found" "$isa, $threads threads, $*"
}
golden() {
    precision=$1 isa=$2 times=$3
    shift 3
    # Fails by itself when the digest is not the one in the blob.
    found=$("$@" verify -q -m "$work/$precision.sfw" --run --isa "$isa" --threads 1,2,3,8 --repeat "$times" --json |
        digest run_digest) || found=
    note "$precision" golden "$found" "$isa, $*"
}

ran= missing=
for isa in $names; do
    if ! STREETFORWARD_CPU=$isa "$native" doctor -q >/dev/null 2>&1; then
        missing="$missing $isa"
        continue
    fi
    ran="$ran $isa"
    for precision in f16 int8; do
        golden $precision "$isa" "$repeats" "$native"
        for threads in 1 2 3 8; do
            clip $precision 7 0,5,10,15 "$isa" $threads "$native"
            clip $precision 101 0,5 "$isa" $threads "$native"
            clip $precision 105 3 "$isa" $threads "$native"
        done
    done
done

cpus=${SF_AARCH64-max cortex-a53}
target=aarch64-unknown-linux-gnu
emulated=
if [ -n "$cpus" ] && [ "$(uname -m)" = x86_64 ] && command -v qemu-aarch64 >/dev/null &&
    command -v aarch64-linux-gnu-gcc >/dev/null && [ -d "$(rustc --print sysroot)/lib/rustlib/$target/lib" ]; then
    CARGO_TARGET_AARCH64_UNKNOWN_LINUX_GNU_LINKER=aarch64-linux-gnu-gcc \
        cargo build -q -p streetforward-cli --target $target
    arm=${CARGO_TARGET_DIR:-target}/$target/debug/streetforward
    for cpu in $cpus; do
        case $cpu in cortex-a53) isa=neon ;; *) isa=neondot ;; esac
        set -- qemu-aarch64 -cpu "$cpu" -L /usr/aarch64-linux-gnu "$arm"
        for precision in f16 int8; do
            "$@" convert -q "$checkpoint" --to $precision -o "$work/again.sfw" --force >/dev/null
            cmp "$work/$precision.sfw" "$work/again.sfw" || echo "conversion to $precision on $cpu" >>"$faults"
            golden $precision $isa 1 "$@"
            clip $precision 7 0,5,10,15 $isa 2 "$@"
            clip $precision 101 0,5 $isa 3 "$@"
            clip $precision 105 3 $isa 1 "$@"
        done
        emulated="$emulated $cpu($isa)"
    done
fi
echo "ran:$ran; emulated:${emulated:- none}; not on this CPU:${missing:- none}; $(wc -l <"$work/count") digests compared"
case $ran in *scalar*) ;; *) echo "scalar did not run" >&2; exit 1 ;; esac
if [ -s "$faults" ]; then
    echo "digests differ:" >&2
    cat "$faults" >&2
    exit 1
fi
