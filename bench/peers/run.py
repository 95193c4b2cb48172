"""The whole network beside other runtimes: one clip, the same weights, alternating rounds in one run.

    python bench/peers/run.py --model models/nano/nano.safetensors --size 252x168 -o nano-252x168
    python bench/peers/run.py --preset base --size 252x168 --rounds 5

Needs `cargo build --release` and `cargo build --release --manifest-path bench/peers/worker/Cargo.toml` done before,
the packages of train/requirements.txt and of the requirements.txt here. `--prepare-only` makes the files, so that the measured run
finds them. README.md here says what is compared.
"""

import argparse
import json
import subprocess
import sys
from pathlib import Path

import numpy as np

HERE = Path(__file__).resolve().parent
ROOT = HERE.parents[1]
sys.path[:0] = [str(HERE), str(ROOT / "train")]

import prepare  # noqa: E402
import rounds  # noqa: E402
from prepare import made  # noqa: E402
from rounds import Peer, digits, milliseconds, python, table  # noqa: E402

# f32 against f32: what different orders of summation may do (measured: a tenth of it).
AGREE = {"depth_absrel": 1e-3, "rotation_deg": 0.02, "centre_share": 1e-3, "velocity_epe": 2e-3, "dynamic": 1e-3}
SAME = {"f32": "f32", "int8": "int8", "bf16": "int8"}


def say(text):
    print(text, file=sys.stderr, flush=True)


PROGRAM = ROOT / "target/release/streetforward"


def cli(*args):
    done = subprocess.run([str(PROGRAM), *map(str, args)], capture_output=True, text=True)
    if done.returncode:
        sys.exit(f"streetforward {args[0]}: {done.stderr.strip().splitlines()[-1]}")


def clip(folder, frames, size):
    """Pictures u8 [F, H, W, 3] of a clip folder at a size, and their times."""
    from PIL import Image

    listed = json.loads((folder / "transforms.json").read_text())["frames"]
    chosen = [listed[i] for i in frames]
    pictures = [Image.open(folder / f["file_path"]).convert("RGB").resize(size, Image.Resampling.BICUBIC) for f in chosen]
    return np.stack([np.asarray(p) for p in pictures]), np.array([float(f["time"]) for f in chosen])


class Files:
    """Everything on disk for one network and size."""

    def __init__(self, args):
        self.args, self.width, self.height = args, *(int(n) for n in args.size.split("x"))
        self.folder = args.work
        self.folder.mkdir(parents=True, exist_ok=True)
        self.why = {}
        name = args.preset or args.model.stem
        self.checkpoint = args.model
        if args.preset:
            self.checkpoint = self.folder / f"{name}.safetensors"
            if not self.checkpoint.exists():
                cli("init", "--preset", args.preset, "--seed", args.seed, "-o", self.checkpoint)
        self.blobs = {}
        for precision in ("f32", "int8"):
            blob = self.folder / f"{name}-{precision}.sfw"
            # Again when the program or the weights are newer: another recipe makes another network.
            newest = max(f.stat().st_mtime for f in (PROGRAM, self.checkpoint))
            if not blob.exists() or blob.stat().st_mtime < newest:
                cli("convert", self.checkpoint, "--to", precision, "-o", blob, "--force")
            self.blobs[precision] = blob
        self.stem = self.folder / f"{name}-{len(args.frames)}x{self.width}x{self.height}"
        self.name = name

    def path(self, end):
        return Path(f"{self.stem}{end}")

    def inputs(self):
        """The clip for every process, and the calibration set."""
        import torch
        from streetforward.graph import inputs
        from streetforward.graph import read_config

        config = read_config(self.checkpoint)
        size = (self.width, self.height)

        def write(stem, folder, frames):
            images, times = clip(folder, frames, size)
            paths = {"images": self.path(f"{stem}.images.npy"), "time": self.path(f"{stem}.time.npy")}
            np.save(paths["images"], images)
            np.save(paths["time"], inputs(config, torch.from_numpy(images), torch.from_numpy(times))[1].numpy())
            return images, times, {k: str(v) for k, v in paths.items()}

        images, times, self.feed = write("", self.args.clip, self.args.frames)
        self.raw = self.path(".rgb")
        self.raw.write_bytes(images.tobytes())
        feeds = []
        for seed in range(1001, 1001 + self.args.calibration):
            folder = self.folder / f"street-{seed}"
            if not folder.exists():
                cli("synth", "--seed", seed, "--frames", 20, "--size", "252x168", "--fps", 10, "-o", folder)
            step = self.args.frames[1] - self.args.frames[0] if len(self.args.frames) > 1 else 1
            feeds.append(write(f".{seed}", folder, [min(19, step * i) for i in range(len(self.args.frames))])[2])
        self.feeds = self.path(".feeds.json")
        self.feeds.write_text(json.dumps(feeds))
        return config, images, times

    def make(self):
        shape = (len(self.args.frames), self.width, self.height)
        f32 = self.path(".onnx")
        self.why["f32"] = made(f32, "onnx_network", self.checkpoint, *shape, f32)
        if self.why["f32"]:
            sys.exit(f"the network cannot be exported: {self.why['f32']}")
        int8, ov, ov8 = self.path(".int8.onnx"), self.path(".xml"), self.path(".int8.xml")
        if "onnxruntime-int8" in self.args.runtimes:
            self.why["onnxruntime-int8"] = made(int8, "onnx_int8", f32, int8)
        if self.args.runtimes & {"openvino-f32", "openvino-int8", "openvino-bf16"}:
            self.why["openvino-f32"] = made(ov, "openvino_f32", f32, ov)
        if "openvino-int8" in self.args.runtimes:
            self.why["openvino-int8"] = made(ov8, "openvino_int8", ov, ov8, self.feeds)


def peers(files, args, times):
    worker = HERE / "worker/target/release/sf-peer-worker"
    if not worker.exists():
        sys.exit(f"{worker} is not built: cargo build --release --manifest-path bench/peers/worker/Cargo.toml")
    size = [len(args.frames), files.width, files.height, args.threads, files.raw]
    rest = [",".join(repr(float(t)) for t in times)]
    ours = [
        Peer("StreetForward", p, [str(v) for v in [worker, "network", files.blobs[p], *size, *rest]])
        for p in ("int8", "f32")
        if f"ours-{p}" in args.runtimes
    ]
    common = {"kind": "network", "threads": args.threads, "checkpoint": str(files.checkpoint), **files.feed}

    def runtime(name, precision, note="", **more):
        key = f"{more['runtime']}-{precision}"
        if key not in args.runtimes:
            return None
        peer = Peer(name, precision, python({**common, "precision": precision, **more}), baseline=ours, note=note)
        peer.failure = files.why.get(key)
        return peer

    ort, ov, pt = "ONNX Runtime", "OpenVINO", "PyTorch"
    found = [
        runtime(ort, "f32", runtime="onnxruntime", model=str(files.path(".onnx"))),
        runtime(ort, "int8", "dynamic, linear layers", runtime="onnxruntime", model=str(files.path(".int8.onnx"))),
        runtime(ov, "f32", runtime="openvino", model=str(files.path(".xml"))),
        runtime(ov, "int8", "NNCF, static", runtime="openvino", model=str(files.path(".int8.xml"))),
        runtime(ov, "bf16", "hint", runtime="openvino", model=str(files.path(".xml")), hint="bf16"),
        runtime(pt, "f32", runtime="pytorch"),
        runtime(pt, "bf16", runtime="pytorch"),
        runtime(pt, "int8", "dynamic, linear layers", runtime="pytorch"),
    ]
    return ours + [p for p in found if p is not None]


def outputs(peer, folder, config, images, times):
    """What a peer's last run says, as tensors named as in the training code."""
    import torch
    from streetforward.graph import finish

    frames, height, width, _ = images.shape
    if peer.ours:
        shapes = {"pose": (frames, 4, 4), "depth": (), "opacity": (), "dynamic": (), "quat": (4,)}
        found = {}
        for file in sorted(folder.glob("*.f32")):
            tail = shapes.get(file.stem, (3,))
            shape = tail if file.stem == "pose" else (frames, height, width, *tail)
            found[file.stem] = torch.from_numpy(np.fromfile(file, "<f4").reshape(shape))
        return found
    raw = {file.stem: np.load(file) for file in folder.glob("*.npy")}
    return finish(raw, torch.from_numpy(images), torch.from_numpy(times), config)


def errors(have, want):
    """How far one result is from another: depth, cameras, motion."""
    turn = have["pose"][:, :3, :3].double() @ want["pose"][:, :3, :3].double().mT
    cosine = ((turn.diagonal(dim1=1, dim2=2).sum(-1) - 1) / 2).clamp(-1, 1)
    # Near zero the sine tells more than the cosine.
    sine = (turn - turn.mT).flatten(1).norm(dim=1) / 8**0.5
    centres = [pose["pose"][:, :3, 3].double() for pose in (have, want)]
    reach = (centres[1] - centres[1][0]).norm(dim=1).max().clamp_min(1e-9)
    found = {
        "depth_absrel": ((have["depth"] - want["depth"]).abs() / want["depth"]).mean().item(),
        "rotation_deg": sine.atan2(cosine).rad2deg().max().item(),
        "centre_share": ((centres[0] - centres[1]).norm(dim=1).max() / reach).item(),
    }
    if "v_fwd" in want and "v_fwd" in have:
        found["velocity_epe"] = (have["v_fwd"] - want["v_fwd"]).norm(dim=-1).mean().item()
        found["dynamic"] = (have["dynamic"] - want["dynamic"]).abs().mean().item()
    return found


def judge(running, files, config, images, times):
    """Errors of every peer against ONNX Runtime's f32; ends the program when ours in f32 is another network."""
    found = {}
    for peer in running:
        folder = files.folder / "outputs" / peer.label.replace(" ", "-")
        peer.save(folder)
        found[peer] = outputs(peer, folder, config, images, times)
    base = next((p for p in running if (p.name, p.precision) == ("ONNX Runtime", "f32")), None)
    base = base or next((p for p in running if p.precision == "f32"), None)
    if base is None:
        say("no f32 runtime: errors are not known")
        return {}
    result = {peer: errors(out, found[base]) for peer, out in found.items()}
    for peer, measured in result.items():
        if peer.precision == "f32":
            over = [k for k, bound in AGREE.items() if not measured.get(k, 0.0) <= bound]
            if over:
                sys.exit(f"{peer.label} computes another network: {', '.join(f'{k} {measured[k]:.2e}' for k in over)}")
    return result


def markdown(title, rows, machine):
    head = ["runtime", "ms", "rounds", "x ours", "x ours, same precision", "start s", "peak MB"]
    head += ["depth abs-rel", "rotation deg", "velocity m/s"]
    lines, cannot = [], []
    for row in rows:
        name = f"{row['runtime']} {row['precision']}" + (f" ({row['note']})" if row["note"] else "")
        if "median_ms" not in row:
            cannot.append(f"* {name}: {row['failure']}")
            continue
        error = row.get("error") or {}
        velocity = error.get("velocity_epe")
        lines.append([
            name,
            milliseconds(row["median_ms"]),
            f"{milliseconds(row['round_low_ms'])} to {milliseconds(row['round_high_ms'])}",
            digits(row["times_ours"], "{:.2f}"),
            digits(row["times_ours_same_precision"], "{:.2f}"),
            digits(row["cold_start_s"], "{:.2f}"),
            digits(row["peak_rss_bytes"] / 1e6, "{:.0f}"),
            digits(error.get("depth_absrel"), "{:.5f}"),
            digits(error.get("rotation_deg"), "{:.4f}"),
            digits(velocity, "{:.4f}"),
        ])
    text = f"{title}; {machine['cpu']}, {machine['cores']} cores, {' '.join(machine['instructions'])}; {machine['date']}\n\n"
    return text + table(head, lines) + ("\n\n" + "\n".join(cannot) if cannot else "") + "\n"


EVERY = "ours-int8,ours-f32,onnxruntime-f32,onnxruntime-int8,openvino-f32,openvino-int8,openvino-bf16,pytorch-f32,pytorch-bf16,pytorch-int8"


def main():
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    network = parser.add_mutually_exclusive_group(required=True)
    network.add_argument("--model", type=Path, help="checkpoint (.safetensors)")
    network.add_argument("--preset", choices=["nano", "base", "full"], help="seeded random weights")
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("--size", default="252x168", help="WxH")
    parser.add_argument("--clip", type=Path, default=ROOT / "models/demo-clip")
    parser.add_argument("--frames", type=lambda t: [int(n) for n in t.split(",")], default=[0, 5, 10, 15])
    parser.add_argument("--threads", type=int, default=2)
    parser.add_argument("--rounds", type=int, default=7)
    parser.add_argument("--turn-ms", type=float, default=500, help="time of a turn; at least one run")
    parser.add_argument("--cold", type=int, default=3, help="starts of every process")
    parser.add_argument("--calibration", type=int, default=8, help="generated streets for static int8")
    parser.add_argument("--limit", type=float, default=120, help="seconds for a first result")
    parser.add_argument("--runtimes", type=lambda t: set(t.split(",")), default=set(EVERY.split(",")), help=EVERY)
    parser.add_argument("--work", type=Path, default=ROOT / "target/peers", help="folder for prepared files")
    parser.add_argument("--prepare-only", action="store_true")
    parser.add_argument("-o", "--output", type=Path, help="writes OUTPUT.json and OUTPUT.md")
    args = parser.parse_args()
    unknown = args.runtimes - set(EVERY.split(","))
    if unknown:
        parser.error(f"--runtimes {', '.join(sorted(unknown))}: known are {EVERY}")

    files = Files(args)
    config, images, times = files.inputs()
    files.make()
    if args.prepare_only:
        return
    everyone = peers(files, args, times)
    try:
        running = rounds.start([p for p in everyone if not p.failure], args.cold, args.limit, say)
        error = judge(running, files, config, images, times)
        rounds.alternate(running, args.rounds, args.turn_ms, say)
    finally:
        for peer in everyone:
            peer.end()
    rows = rounds.report(everyone, SAME)
    for peer, row in zip(everyone, rows):
        row["error"] = error.get(peer)
    machine = rounds.machine()
    title = f"{files.name}, {len(args.frames)} frames of {args.size}, {args.threads} threads, {args.rounds} rounds"
    text = markdown(title, rows, machine)
    print(text)
    if args.output:
        document = {
            "schema": "streetforward.peers/1",
            "network": files.name,
            "frames": len(args.frames),
            "width": files.width,
            "height": files.height,
            "threads": args.threads,
            "machine": machine,
            "versions": rounds.versions("torch", "onnx", "onnxruntime", "openvino", "nncf", "numpy"),
            "command": "python " + " ".join(sys.argv),
            "results": rows,
        }
        Path(f"{args.output}.json").write_text(json.dumps(document, indent=1) + "\n")
        Path(f"{args.output}.md").write_text(text)


if __name__ == "__main__":
    main()
