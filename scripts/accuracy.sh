#!/bin/sh
# What f16 and int8 cost the trained network: the accuracy table of README.md, as Markdown. Generated streets that no
# training sees; int8 is calibrated on streets of the training split, keeps the camera decoder in f16 and is scanned for more layers to
# keep (minutes).
#
#   scripts/accuracy.sh [MODEL [EVALUATED]]    checkpoint, models/nano/nano.safetensors by default; streets of `eval`, 8
#
# Exit 1 when int8 misses a gate (docs/quantization.md).
set -eu
cd "$(dirname "$0")/.."
checkpoint=${1:-models/nano/nano.safetensors}
evaluated=${2:-8}
work=$(mktemp -d)
trap 'rm -rf "$work"' EXIT
program=${STREETFORWARD:-target/release/streetforward}
[ -x "$program" ] || cargo build -q --release -p streetforward-cli

clips= calibration=
for seed in 101 105 110 111; do
    "$program" synth -q --seed $seed --frames 20 --size 168x112 -o "$work/clip$seed" >/dev/null
    clips="$clips $work/clip$seed"
done
for seed in 102 104 106 109; do
    "$program" synth -q --seed $seed --frames 20 --size 168x112 -o "$work/clip$seed" >/dev/null
    calibration="$calibration $work/clip$seed"
done
"$program" convert -q "$checkpoint" --to f32 -o "$work/f32.sfw" >/dev/null
"$program" convert -q "$checkpoint" --to f16 -o "$work/f16.sfw" >/dev/null
# shellcheck disable=SC2086
"$program" convert -q "$checkpoint" --to int8 --keep camera_decoder.=f16 --calib $calibration --check $clips --frames 0,5,10,15 --allow-inaccurate \
    -o "$work/int8.sfw" >/dev/null

missed=
for precision in f16 int8; do
    # shellcheck disable=SC2086
    "$program" compare -q "$work/f32.sfw" "$work/$precision.sfw" -i $clips --frames 0,5,10,15 --gate int8 --outputs-only --json \
        >"$work/$precision.compare" || missed="$missed $precision"
done
for precision in f32 f16 int8; do
    "$program" eval -q -m "$work/$precision.sfw" --synth-heldout "$evaluated" --seed 200 --json >"$work/$precision.eval"
done

# value FILE KEY DIGITS: the first number under a key.
value() {
    sed -n "s/.*\"$2\": \(-\{0,1\}[0-9][0-9.e-]*\).*/\1/p" "$1" | head -n 1 | awk -v d="$3" '{ printf "%.*f", d, $1 }'
}
echo "| against f32, 4 streets | bound | f16 | int8 |"
echo "|---|---:|---:|---:|"
row() {
    echo "| $1 | $3 | $(value "$work/f16.compare" "$2" "$4") | $(value "$work/int8.compare" "$2" "$4") |"
}
row "depth, abs-rel" depth_absrel "0.01" 4
row "rotation, median, degrees" rotation_deg_median "0.06" 4
row "direction of travel, median, degrees" translation_deg_median "0.3" 3
row "velocity of moving pixels, m/s" velocity_epe "0.10" 3
row "velocity, share of the mean speed" velocity_epe_rel "0.02" 4
row "moving mask, share of pixels that differ" dynamic_flip_fraction "0.003" 5
row "render, dB" render_psnr_db "45" 1
row "render, moving pixels, dB" render_psnr_dynamic_db "42" 1
row "render, worst picture, dB" render_psnr_worst_db "38" 1
row "farther from the true pictures, dB" truth_psnr_fall "0.10" 3
echo
echo "| against the truth, $evaluated streets | f32 | f16 | int8 |"
echo "|---|---:|---:|---:|"
row() {
    echo "| $1 | $(value "$work/f32.eval" "$2" "$3") | $(value "$work/f16.eval" "$2" "$3") | $(value "$work/int8.eval" "$2" "$3") |"
}
row "PSNR of frames not given, dB" psnr_full_db 3
row "the same, moving pixels, dB" psnr_dynamic_db 3
row "SSIM" ssim_full 4
row "depth, RMSE, m" depth_rmse_full 3
row "velocity, m/s" velocity_epe 3
echo
case $missed in *int8*) echo "int8 misses a gate" >&2; exit 1 ;; esac
