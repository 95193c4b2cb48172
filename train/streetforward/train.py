"""Trains a network from scratch on generated streets, on labels.

    python -m streetforward.train --out RUN --cache CLIPS --generator PATH --minutes 100 --ranks 2

Resumes by itself when RUN holds a checkpoint. `docs/training.md` walks through it.
"""

import argparse
import math
import time
from pathlib import Path

import torch

from . import config as cfg
from . import probe, ranks
from .batched import Wanted, forward_clips
from .calibrate import calibrate_camera
from .data import Chunks, Loader, Sampler, collate, held_out, read_clip
from .evaluate import evaluate, picture
from .journal import note, resume, save
from .losses import (
    camera_losses,
    focal_loss,
    log_depth_loss,
    matching_loss,
    motion_losses,
    patch_matches,
    sky_loss,
)
from .optim import Optimizer
from .weights import read_model, scratch_start, write_model

KEEP_STILL = ("decoder.1", "decoder.3")  # global layers whose first head is taught to match
KEEP_MOTION = ("causal.0",)
TELL_STILL = ("decoder.3", "decoder.5")  # layers after which tokens are asked for displacements
TELL_MOTION = ("causal.1",)

WEIGHTS = {
    "depth": 1.0,
    "slope": 0.5,
    "sky": 0.2,
    "rotation": 10.0,
    "translation": 0.4,
    "focal": 2.0,
    "velocity": 0.2,  # per pass, summed over the three axes
    "dynamic": 0.4,  # per pass
    "matching": 0.6,  # shared by the supervised heads
    "displacement": 1.5,  # shared by the probed layers
}


def learning_rate(fraction, steps, warmup=60, floor=0.03):
    """Warm-up by steps, then a cosine over the budget down to `floor`."""
    cosine = floor + (1 - floor) * (1 + math.cos(math.pi * min(fraction, 1.0))) / 2
    return min(1.0, (steps + 1) / warmup) * cosine


def leak(fraction, start=0.1, until=0.6):
    """Slope of the camera head's units on negative inputs: falls to 0, the network's own ReLU, at `until`."""
    return max(0.0, start * (1 - fraction / until))


def choose(count, frames, first, last, per_clip, generator):
    """Rows of `per_clip` random frames in first..last of each of `count` clips."""
    order = torch.rand(count, last - first + 1, generator=generator).argsort(1)[:, :per_clip] + first
    return (order + frames * torch.arange(count)[:, None]).flatten()


def step_losses(model, batch, fraction, args, generator):
    """All losses of a batch by name, each weighted as it enters the sum."""
    config = model.config
    count, frames, height, width = batch.depth.shape
    moving = fraction >= args.motion_from
    device = batch.images.device
    wanted = Wanted(depth=choose(count, frames, 0, frames - 1, args.depth_frames, generator).to(device))
    keep = KEEP_STILL if args.matching else ()
    tell = TELL_STILL if hasattr(model, probe.NAME) else ()
    if moving:
        wanted.motion = {
            "fwd": choose(count, frames, 0, frames - 2, args.motion_frames, generator).to(device),
            "bwd": choose(count, frames, 1, frames - 1, args.motion_frames, generator).to(device),
        }
        keep += KEEP_MOTION if args.matching else ()
        tell += TELL_MOTION if tell else ()
    with torch.autocast(device.type, torch.bfloat16, enabled=args.bf16):
        raw = forward_clips(model, batch.images, batch.times, wanted, keep, tell)

    depth = batch.depth.flatten(0, 1)
    truth = depth[wanted.depth]
    loss = {}
    loss["depth"], loss["slope"] = log_depth_loss(raw.log_depth(config), truth)
    if raw.solid(config) is not None:
        loss["sky"] = sky_loss(raw.solid(config), truth)
    loss["rotation"], loss["translation"] = camera_losses(raw.rotation, raw.translation, batch.pose)
    if raw.fov is not None:
        loss["focal"] = focal_loss(raw.fov, batch.focal, (width, height))
    if moving:
        velocity = batch.velocity.flatten(0, 1)
        loss["velocity"] = loss["dynamic"] = 0
        for way, rows in wanted.motion.items():
            sign = config["motion.back_sign"] if way == "bwd" else 1
            # Backward velocities point where the surface came from; a sign of -1 leaves the head the surface's own.
            target = velocity[rows] * (sign if way == "fwd" else -sign)
            value, mask = motion_losses(raw.motion[way], target, depth[rows], config)
            loss["velocity"], loss["dynamic"] = loss["velocity"] + value, loss["dynamic"] + mask
    if raw.kept or raw.tokens:
        grid = height // config["patch"], width // config["patch"]
        matches = patch_matches(batch, config["patch"])
        matching = matching_loss(raw.kept, matches, grid)
        loss |= {f"matching.{name}": value for name, value in matching.items()}
        told = probe.displacement_loss(getattr(model, probe.NAME, None), raw.tokens, matches)
        loss |= {f"displacement.{name}": value for name, value in told.items()}

    weighted = {}
    for name, value in loss.items():
        weight = WEIGHTS[name.split(".")[0]]
        if name == "dynamic" and fraction > 2 / 3:
            weight *= 2
        if name.startswith(("matching.", "displacement.")):
            weight /= 2
        weighted[name] = weight * value
    return loss, weighted


class Run:
    """One training process: model, optimiser, data, log and checkpoint."""

    def __init__(self, args, reduce=None):
        self.args, self.reduce = args, reduce
        self.device = torch.device(args.device)
        width, height = (int(n) for n in args.size.split("x"))
        self.model = read_model(args.model) if args.model else scratch_start(cfg.preset(args.preset), args.seed)
        config = self.model.to(self.device).config
        self.chunks = Chunks(args.generator, args.cache, "train", width, height)
        if args.calibrate and not (args.out / "resume.pt").exists():
            clips = [read_clip(self.chunks.clip(i, wait=args.rank > 0)) for i in range(args.calibrate)]
            batches = [collate(clips[i : i + 4]).to(self.device) for i in range(0, len(clips), 4)]
            note(args, event="calibrate", **calibrate_camera(self.model, batches))
        if args.displacement:
            self.model.add_module(probe.NAME, probe.Probe(TELL_STILL + TELL_MOTION, self.chunks.frames, config).to(self.device))
        self.optimizer = Optimizer(
            self.model,
            lambda name: not name.startswith("gs_"),
            lr=args.lr,
            muon_lr=args.muon_lr,
            ema=args.ema,
        )
        self.samples, self.elapsed = 0, 0.0
        resume(self)
        sampler = Sampler(args.seed, args.window, args.reuse, args.first_clip)
        self.loader = Loader(self.chunks, sampler, args.batch, self.samples, args.rank, args.ranks)
        self.records = held_out(Chunks(args.generator, args.cache, "held-out", width, height), args.eval_clips)

    def evaluate(self):
        began = time.time()
        self.optimizer.swap()
        entry = evaluate(
            self.model, self.records, self.device, rank=self.args.rank, ranks=self.args.ranks, reduce=self.reduce
        )
        if self.args.rank == 0:
            picture(self.model, self.records[:4], self.args.out / f"sheet-{self.samples:07}.png", self.device)
            write_model(self.args.out / "ema.safetensors", self.model)
        self.optimizer.swap()
        note(self.args, event="eval", samples=self.samples, elapsed=self.elapsed, seconds=time.time() - began, **entry)

    def train(self):
        args, budget = self.args, 60 * self.args.minutes
        began, mean, last_eval, last_save = time.time() - self.elapsed, {}, self.elapsed, self.elapsed
        count, log_start, log_samples = 0, time.time(), self.samples
        clock, stop = torch.zeros(2, dtype=torch.float64), args.out / "stop"
        while True:
            # Rank 0's clock decides for all.
            clock[0], clock[1] = time.time() - began, stop.exists()
            if args.ranks > 1:
                torch.distributed.broadcast(clock, 0)
            self.elapsed = now = clock[0].item()
            fraction = now / budget
            if fraction >= 1 or clock[1] or (args.steps and self.optimizer.steps >= args.steps):
                break
            self.model.camera_head.leak(leak(fraction, args.leak))
            batch = self.loader.next().to(self.device)
            generator = torch.Generator().manual_seed((args.seed << 40) + (self.samples << 3) + args.rank)
            loss, weighted = step_losses(self.model, batch, fraction, args, generator)
            total = sum(weighted.values())
            total.backward()
            scale = learning_rate(fraction, self.optimizer.steps)
            norm = self.optimizer.step(scale, args.rank, args.ranks, self.reduce)
            self.samples += args.batch
            count += 1
            values = {name: float(value.detach()) for name, value in loss.items()}
            for name, value in (values | {"total": float(total.detach()), "norm": norm}).items():
                a, n = mean.get(name, (0.0, 0))
                mean[name] = a + value, n + 1
            if count % args.log_every == 0:
                rate = (self.samples - log_samples) / (time.time() - log_start)
                means = {name: a / n for name, (a, n) in mean.items()}
                note(self.args, step=self.optimizer.steps, samples=self.samples, elapsed=now, lr=scale, rate=rate, **means)
                mean, log_start, log_samples = {}, time.time(), self.samples
            if now - last_save > 60 * args.save_minutes:
                save(self)
                last_save = now
            if now - last_eval > 60 * args.eval_minutes:
                self.evaluate()
                last_eval = now
                log_start, log_samples = time.time(), self.samples
        save(self)
        self.evaluate()


def parser():
    p = argparse.ArgumentParser(prog="streetforward.train", description=__doc__.splitlines()[0])
    p.add_argument("--out", type=Path, required=True, help="folder of the run: log, sheets, checkpoint; a file `stop` in it ends the run")
    p.add_argument("--cache", type=Path, required=True, help="folder for generated clips")
    p.add_argument("--generator", type=Path, required=True, help="the clip generator's `stream` example")
    p.add_argument("--preset", default="nano")
    p.add_argument("--model", type=Path, help="start from these weights instead of from scratch")
    p.add_argument("--size", default="168x112")
    p.add_argument("--seed", type=int, default=1)
    p.add_argument("--minutes", type=float, default=100, help="training time of the whole schedule, resumptions added up")
    p.add_argument("--steps", type=int, default=0, help="stop after this many steps; 0: only time counts")
    p.add_argument("--batch", type=int, default=4)
    ranks.add_arguments(p)
    p.add_argument("--device", default="cpu")
    p.add_argument("--bf16", action="store_true", help="bf16 autocast; needs bf16 units to be faster")
    p.add_argument("--lr", type=float, default=1e-3)
    p.add_argument("--muon-lr", type=float, default=2e-3)
    p.add_argument("--ema", type=float, default=0.999)
    p.add_argument("--window", type=int, default=1024)
    p.add_argument("--reuse", type=float, default=3.0)
    p.add_argument("--first-clip", type=int, default=0, help="number of the first clip; another one, other streets")
    p.add_argument("--calibrate", type=int, default=0, help="clips that set the camera head's start (calibrate.py)")
    p.add_argument("--motion-from", type=float, default=0.3, help="part of the schedule without motion")
    p.add_argument("--depth-frames", type=int, default=2, help="frames of a clip whose depth is computed")
    p.add_argument("--motion-frames", type=int, default=2, help="frames of a clip and pass whose motion is computed")
    p.add_argument("--no-matching", dest="matching", action="store_false")
    p.add_argument("--no-displacement", dest="displacement", action="store_false")
    p.add_argument("--leak", type=float, default=0.1, help="slope of the camera head's units on negative inputs at the start")
    p.add_argument("--eval-clips", type=int, default=96)
    p.add_argument("--eval-minutes", type=float, default=10)
    p.add_argument("--save-minutes", type=float, default=3)
    p.add_argument("--log-every", type=int, default=20)
    return p


def main(argv=None):
    args = parser().parse_args(argv)
    args.out.mkdir(parents=True, exist_ok=True)
    ranks.run("streetforward.train", args, argv, lambda reduce: Run(args, reduce).train())


if __name__ == "__main__":
    main()
