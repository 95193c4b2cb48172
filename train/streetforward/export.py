"""Command line: golden tensors and seeded checkpoints.

    python -m streetforward.export golden --out ../tests/data/golden
    python -m streetforward.export checkpoint --preset nano --seed 1 -o nano.safetensors
"""

import argparse
import sys
from pathlib import Path

import torch
from safetensors.torch import save_file
from torch.nn.attention import SDPBackend, sdpa_kernel

from . import config as cfg
from .golden import CASES
from .weights import golden_model, read_model, training_start, write_model

# Largest difference, relative to the largest value of a stage, that plain f32 arithmetic may show against f64. A case
# above it would be too badly conditioned to judge another implementation at 1e-4.
F32_LIMIT = 3e-5


def write(path, tensors, metadata):
    """Writes a safetensors file whole or not at all."""
    partial = path.with_name(path.name + ".partial")
    save_file(tensors, partial, metadata)
    partial.replace(path)


def run_stages(model, case):
    """Every stage of a case in the model's arithmetic, as contiguous CPU tensors."""
    stages = {}
    images, times = torch.from_numpy(case.images()), torch.from_numpy(case.times())
    with torch.no_grad(), sdpa_kernel(SDPBackend.MATH):
        model(images, times, stages)
    return {name: tensor.contiguous() for name, tensor in stages.items()}


def deviation(a, b):
    """Largest difference over the largest value; quaternion signs are free."""
    a, b = a.to(torch.float64), b.to(torch.float64)
    scale = max(b.abs().max().item(), 1e-30)
    return (a - b).abs().max().item() / scale


def golden_case(case):
    """Tensors of a golden file: weights `w.*`, inputs `in.*` and stages.

    The stages are computed in f64 from f32 weights and rounded once at the end: what an exact f32 implementation
    should come close to. The same model in f32 must come close too.
    """
    config = case.config()
    model = golden_model(config, case.seed)
    weights = {f"w.{name}": p.detach().clone() for name, p in model.state_dict().items()}
    single = run_stages(model, case)
    exact = {name: tensor.to(torch.float32) for name, tensor in run_stages(model.double(), case).items()}
    worst_name, worst = max(((name, deviation(single[name], exact[name])) for name in exact), key=lambda pair: pair[1])
    broken = [name for name, tensor in exact.items() if not tensor.isfinite().all()]
    if broken or worst > F32_LIMIT:
        raise SystemExit(f"{case.name}: {worst_name} differs by {worst:.1e} in f32, not finite: {broken}")
    if (exact["k"] <= 0).any():
        raise SystemExit(f"{case.name}: no camera has the focal lengths {exact['k'][:, :2].tolist()}")
    inputs = {"in.images": torch.from_numpy(case.images()), "in.times": torch.from_numpy(case.times())}
    return weights | inputs | exact, {cfg.METADATA_KEY: cfg.to_json(config)}, f"{worst:.1e} at {worst_name}"


def export_golden(args):
    torch.set_num_threads(1)
    torch.use_deterministic_algorithms(True)
    args.out.mkdir(parents=True, exist_ok=True)
    total = 0
    for case in CASES:
        if args.only and case.name not in args.only:
            continue
        tensors, metadata, worst = golden_case(case)
        path = args.out / f"{case.name}.safetensors"
        write(path, tensors, metadata)
        total += path.stat().st_size
        stages = sum(not name.startswith(("w.", "in.")) for name in tensors)
        print(f"{path.name:26} {path.stat().st_size:8} bytes  {stages:2} stages  f32 against f64: {worst}")
    print(f"{total} bytes in all")


def export_checkpoint(args):
    config = cfg.preset(args.preset)
    if args.linear_heads:
        config = cfg.with_linear_heads(config)
    model = training_start(config, args.seed)
    tensors = {name: p.detach().contiguous() for name, p in model.state_dict().items()}
    write(args.output, tensors, {cfg.METADATA_KEY: cfg.to_json(config)})
    print(f"{args.output}: {len(tensors)} tensors, {sum(p.numel() for p in tensors.values())} parameters")


def export_shrunk(args):
    model = read_model(args.model)
    write_model(args.output, model, {"f16": torch.float16, "f32": torch.float32}[args.dtype])
    print(f"{args.output}: {args.output.stat().st_size} bytes")


def main(argv=None):
    parser = argparse.ArgumentParser(prog="streetforward.export", description=__doc__.splitlines()[0])
    verbs = parser.add_subparsers(required=True)
    golden = verbs.add_parser("golden", help="write the golden tensors")
    golden.add_argument("--out", type=Path, required=True, help="folder for one file per case")
    golden.add_argument("--only", nargs="*", default=[], help="names of the cases to write")
    golden.set_defaults(run=export_golden)
    checkpoint = verbs.add_parser("checkpoint", help="write a seeded model as training starts")
    checkpoint.add_argument("--preset", default="nano", choices=["nano", "base", "full", "pi3"])
    checkpoint.add_argument("--linear-heads", action="store_true", help="Gaussian and motion heads of Pi3's kind")
    checkpoint.add_argument("--seed", type=int, default=1)
    checkpoint.add_argument("-o", "--output", type=Path, required=True)
    checkpoint.set_defaults(run=export_checkpoint)
    shrink = verbs.add_parser("shrink", help="rewrite a trained checkpoint in another precision")
    shrink.add_argument("model", type=Path)
    shrink.add_argument("--dtype", default="f16", choices=["f16", "f32"])
    shrink.add_argument("-o", "--output", type=Path, required=True)
    shrink.set_defaults(run=export_shrunk)
    args = parser.parse_args(argv)
    args.run(args)


if __name__ == "__main__":
    sys.exit(main())
