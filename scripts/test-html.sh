#!/bin/sh
# Opens exported pages in headless Chromium and judges what it draws. Not part of `cargo test`: needs chromium on the
# PATH, and software OpenGL takes seconds a picture.
#
#   scripts/test-html.sh [PAGE]
#
# Without PAGE a street with exact ground truth is drawn, exported and opened, and then the page of `demo` (the built binary is
# target/release/streetforward, or $STREETFORWARD). The page itself compares: `#check` draws every picture of its strip
# again, at source times, between and beyond them, and takes the PSNR against the one that our rasterizer drew when the
# page was made. Both went through JPEG or 8 bits, so 38 dB is the most that can be expected; 32 is asked for.
# Screenshots stay in $OUT (default: a temporary folder, named at the end).
set -eu
cd "$(dirname "$0")/.."
binary=${STREETFORWARD:-target/release/streetforward}
out=${OUT:-$(mktemp -d)}
mkdir -p "$out"
browser=$(command -v chromium || command -v chromium-browser || command -v google-chrome) || {
    echo "chromium is not on the PATH" >&2
    exit 1
}

page=${1:-}
if [ -z "$page" ]; then
    page=$out/street.html
    "$binary" synth --seed 17 -o "$out/clip" --scene "$out/scene" --force >/dev/null
    "$binary" export -s "$out/scene" -o "$page" --clip "$out/clip" --title "Street 17" --force
fi
page=$(realpath "$page")

# One run of the browser on the page with a fragment; its console goes to console.log.
open_page() { # FRAGMENT WxH FLAG...
    fragment=$1
    size=$2
    shift 2
    profile=$(mktemp -d)
    timeout 580 "$browser" --headless --no-sandbox --use-gl=angle --use-angle=swiftshader \
        --enable-unsafe-swiftshader --disable-background-networking --disable-component-update --disable-sync \
        --no-first-run --hide-scrollbars --enable-logging=stderr --user-data-dir="$profile" --window-size="$size" \
        "$@" "file://$page$fragment" 2>"$out/console.log"
    rm -rf "$profile"
    if grep -E 'CONSOLE.*(error|warn|refused|fail)' "$out/console.log" >&2; then
        echo "the console shows faults with $fragment" >&2
        exit 1
    fi
}
report() { sed -n 's/.*<pre id="report"[^>]*>\([^<]*\)<.*/\1/p' "$1"; }
fail() {
    echo "FAILED: $1" >&2
    exit 1
}

open_page '#check' 504,336 --virtual-time-budget=60000 --dump-dom >"$out/check.html"
grep -q '<html[^>]*data-state="ready"' "$out/check.html" || fail "the page did not start"
result=$(report "$out/check.html")
[ -n "$result" ] || fail "the page did not finish its check in time: is the machine busy?"
echo "check  $result"
python3 - "$result" <<'PYTHON'
import json, sys
r = json.loads(sys.argv[1])
assert r["error"] == 0, "WebGL error %d" % r["error"]
assert len(r["pictures"]) > 1
for p in r["pictures"]:
    assert p["psnr_db"] > 32, p
    assert p["lit"] > 0.5, "blank: %r" % p
assert r["moved_share"] > 0.001, "nothing moves between two times"
for mode, psnr in r["modes"].items():
    assert (psnr > 60) == (mode == "rgb"), "colours of %s: %r dB" % (mode, psnr)
print("ok     %d pictures, worst %.1f dB, %.1f %% of the values move" % (
    len(r["pictures"]), min(p["psnr_db"] for p in r["pictures"]), 100 * r["moved_share"]))
PYTHON

for moment in 't=0' 't=0.7&mode=velocity&frame=2' 't=1.3&mode=depth&frame=2&right=1.2&yaw=-8'; do
    picture=$out/shot-$(echo "$moment" | tr -c 'a-z0-9\n' '-').png
    open_page "#$moment" 1280,800 --virtual-time-budget=4000 --screenshot="$picture" >/dev/null
    [ -s "$picture" ] || fail "no screenshot of $moment"
done
[ "$(cat "$out"/shot-*.png | wc -c)" -gt 300000 ] || fail "the screenshots are blank"
cmp -s "$out"/shot-t-0.png "$out"/shot-t-0-7-mode-velocity-frame-2.png && fail "two views look the same"

open_page '#webgl=off' 800,600 --virtual-time-budget=2000 --dump-dom >"$out/plain.html"
grep -q 'data-state="no-webgl"' "$out/plain.html" || fail "no message without WebGL2"

open_page '#bench=10' 640,480 --dump-dom >"$out/bench.html"
echo "bench  $(report "$out/bench.html")"
echo "size   $(wc -c <"$page") bytes"
echo "screenshots and logs: $out"

# A predicted street as well: every frame has a focal length of its own there.
if [ $# -eq 0 ]; then
    "$binary" demo -q -o "$out/demo" --force >/dev/null
    OUT=$out/demo-page scripts/test-html.sh "$out/demo/street.html"
fi
