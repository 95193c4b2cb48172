"""Kernels and a transformer block beside other runtimes, alternating rounds in one run.

    python bench/peers/kernels.py --rounds 7 -o kernels
    python bench/peers/kernels.py --only gemm,linear

Every row is its own set of processes. Ours are the kernels that the network uses, checked against their definitions by the tests.
"""

import argparse
import json
import sys
from pathlib import Path

HERE = Path(__file__).resolve().parent
ROOT = HERE.parents[1]
sys.path.insert(0, str(HERE))

import rounds  # noqa: E402
from prepare import made  # noqa: E402
from rounds import Peer, digits, milliseconds, python, table  # noqa: E402

PRODUCTS = [(868, 1024, 1024), (868, 1024, 3072), (868, 1024, 4096), (868, 4096, 1024), (884, 192, 576), (884, 192, 768), (884, 768, 192), (1956, 128, 384), (1, 1024, 1024)]
MAPS = [(96, 144, 256, 256), (84, 126, 32, 32)]
SIGHTS = [(4, 216, 16, 72, 0, 1), (4, 740, 16, 72, 0, 1)]
BLOCKS = [(4, 217, "frame"), (4, 217, "global"), (4, 745, "frame"), (4, 745, "global")]


def say(text):
    print(text, file=sys.stderr, flush=True)


def ours(threads, kind, sizes, precision="int8", note=""):
    worker = HERE / "worker/target/release/sf-peer-worker"
    return Peer("StreetForward", precision, [str(v) for v in [worker, "work", threads, kind, *sizes]], note=note)


def peer(name, shown, note, threads, **spec):
    spec = {"kind": "op", "threads": threads, "precision": "f32", **spec}
    return Peer(name, shown, python(spec), baseline=(), note=note)


def sets(kinds, threads, work):
    """(group, sizes, operations, peers)."""
    found = []
    for m, k, n in PRODUCTS:
        sizes, count = (m, k, n), 2 * m * k * n
        if "gemm" in kinds:
            found.append(("gemm", sizes, count, [
                ours(threads, "gemm", sizes, note="to f32, with scales and bias"),
                peer("PyTorch", "int8", "_int_mm to i32", threads, runtime="pytorch", op="gemm", sizes=sizes),
                peer("ONNX Runtime", "int8", "MatMulInteger to i32", threads, runtime="onnxruntime", op="gemm", sizes=sizes),
            ]))
        if "linear" in kinds:
            found.append(("linear", sizes, count, [
                ours(threads, "linear", sizes, note="per token, rotated"),
                peer("PyTorch", "int8", "dynamic, x86", threads, runtime="pytorch", op="linear", sizes=sizes, engine="x86"),
                peer("PyTorch", "int8", "dynamic, onednn", threads, runtime="pytorch", op="linear", sizes=sizes, engine="onednn"),
                peer("ONNX Runtime", "int8", "dynamic", threads, runtime="onnxruntime", op="linear", sizes=sizes),
                peer("OpenVINO", "int8", "static", threads, runtime="openvino", op="linear", sizes=sizes),
            ]))
    for sizes in MAPS if "conv" in kinds else []:
        h, w, c, n = sizes
        found.append(("conv", sizes, 18 * h * w * c * n, [
            ours(threads, "conv", sizes, note="f32 in and out"),
            peer("PyTorch", "int8", "u8 in and out, x86", threads, runtime="pytorch", op="conv", sizes=sizes, engine="x86"),
            peer("ONNX Runtime", "int8", "f32 in and out", threads, runtime="onnxruntime", op="conv", sizes=sizes),
            peer("OpenVINO", "int8", "f32 in and out", threads, runtime="openvino", op="conv", sizes=sizes),
        ]))
    for sizes in SIGHTS if "attention" in kinds else []:
        frames, tokens, heads, d, lo, hi = sizes
        seen = sum(0 <= f + o < frames for f in range(frames) for o in range(lo, hi + 1))
        found.append(("attention", sizes, 4 * seen * tokens**2 * heads * d, [
            ours(threads, "attention", sizes),
            peer("PyTorch", "f32", "slices", threads, runtime="pytorch", op="attention", sizes=sizes),
            peer("PyTorch", "f32", "dense mask", threads, runtime="pytorch", op="attention_dense", sizes=sizes),
            peer("OpenVINO", "f32", "slices", threads, runtime="openvino", op="attention", sizes=sizes),
        ]))
    for frames, tokens, sight in BLOCKS if "block" in kinds else []:
        found.append(block(frames, tokens, sight, threads, work))
    return found


def block(frames, tokens, sight, threads, work):
    """A block of `full` on frames alone or on all frames at once."""
    work.mkdir(parents=True, exist_ok=True)
    shape = [frames, tokens, 1024] if sight == "frame" else [1, frames * tokens, 1024]
    reach = (0, 0) if sight == "frame" else (1 - frames, frames - 1)
    stem = work / f"block-{shape[0]}x{shape[1]}"
    onnx, small, ov, ov8 = (str(stem) + end for end in (".onnx", ".int8.onnx", ".xml", ".int8.xml"))
    why = {"onnx": made(onnx, "onnx_block", *shape[:2], onnx)}
    feeds = Path(f"{stem}.feeds.json")
    if not feeds.exists():
        import numpy as np

        samples = []
        for seed in range(4):
            file = f"{stem}.{seed}.npy"
            np.save(file, np.random.default_rng(seed).standard_normal(shape, dtype=np.float32))
            samples.append({"x": file})
        feeds.write_text(json.dumps(samples))
    why["onnx8"], why["ov"] = made(small, "onnx_int8", onnx, small), made(ov, "openvino_f32", onnx, ov)
    why["ov8"] = made(ov8, "openvino_int8", ov, ov8, feeds)
    common = {"threads": threads, "shape": shape}

    def loaded(name, precision, note, key, **spec):
        found = peer(name, precision, note, **common, kind="file", **spec)
        found.failure = why[key]
        return found

    def torch(precision):
        spec = {"kind": "block", "runtime": "pytorch", "precision": precision, "tokens": shape[1]}
        return peer("PyTorch", precision, "dynamic" if precision == "int8" else "", **common, **spec)

    m, dim = frames * tokens, 1024
    seen = tokens if sight == "frame" else m
    count = 24 * m * dim * dim + 4 * m * seen * dim
    return ("block", (frames, tokens, sight), count, [
        ours(threads, "block", (frames, tokens, dim, 16, *reach)),
        loaded("ONNX Runtime", "f32", "", "onnx", runtime="onnxruntime", model=onnx),
        loaded("ONNX Runtime", "int8", "dynamic", "onnx8", runtime="onnxruntime", model=small),
        loaded("OpenVINO", "f32", "", "ov", runtime="openvino", model=ov),
        loaded("OpenVINO", "int8", "NNCF, static", "ov8", runtime="openvino", model=ov8),
        loaded("OpenVINO", "int8", "NNCF, static, bf16 hint", "ov8", runtime="openvino", model=ov8, hint="bf16"),
        loaded("OpenVINO", "bf16", "hint", "ov", runtime="openvino", model=ov, hint="bf16"),
        torch("f32"), torch("bf16"), torch("int8"),
    ])


def main():
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    kinds = "gemm,linear,conv,attention,block"
    parser.add_argument("--only", type=lambda t: t.split(","), default=kinds.split(","), help=kinds)
    parser.add_argument("--threads", type=int, default=2)
    parser.add_argument("--rounds", type=int, default=7)
    parser.add_argument("--turn-ms", type=float, default=80)
    parser.add_argument("--work", type=Path, default=ROOT / "target/peers", help="folder for prepared files")
    parser.add_argument("--prepare-only", action="store_true")
    parser.add_argument("-o", "--output", type=Path, help="writes OUTPUT.json and OUTPUT.md")
    args = parser.parse_args()
    todo = sets(args.only, args.threads, args.work)
    if args.prepare_only:
        return
    results, lines, cannot = [], [], []
    for group, sizes, count, everyone in todo:
        name = f"{group} {'x'.join(str(s) for s in sizes)}"
        try:
            running = rounds.start([p for p in everyone if not p.failure], 1, 60, lambda text: None)
            rounds.alternate(running, args.rounds, args.turn_ms, lambda text: None)
        finally:
            for p in everyone:
                p.end()
        rows = rounds.report(everyone, {})
        say(name)
        results.append({"what": group, "sizes": sizes, "operations": count, "results": rows})
        for row in rows:
            who = f"{row['runtime']} {row['precision']}" + (f" ({row['note']})" if row["note"] else "")
            if "median_ms" not in row:
                cannot.append(f"* {name}, {who}: {row['failure']}")
                continue
            low, high = milliseconds(row["round_low_ms"]), milliseconds(row["round_high_ms"])
            pace = count / row["median_ms"] * 1e-6
            lines.append([name, who, milliseconds(row["median_ms"]), f"{low} to {high}", f"{pace:.0f}", digits(row["times_ours"], "{:.2f}")])
    machine = rounds.machine()
    text = f"{args.threads} threads, {args.rounds} rounds; {machine['cpu']}, {' '.join(machine['instructions'])}; {machine['date']}\n\n"
    text += table(["what", "runtime", "ms", "rounds", "GOP/s", "x ours"], lines) + "\n"
    text += "\n" + "\n".join(cannot) + "\n" if cannot else ""
    print(text)
    if args.output:
        document = {
            "schema": "streetforward.peer-kernels/1",
            "machine": machine,
            "versions": rounds.versions("torch", "onnxruntime", "openvino", "nncf"),
            "results": results,
        }
        Path(f"{args.output}.json").write_text(json.dumps(document, indent=1) + "\n")
        Path(f"{args.output}.md").write_text(text)


if __name__ == "__main__":
    main()
