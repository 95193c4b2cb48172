"""Trains parts of a network through drawn images: the paper's losses on top of a checkpoint.

    python -m streetforward.finetune --model nano.safetensors --out RUN --cache CLIPS --generator PATH --minutes 15
    python -m streetforward.finetune --model pi3.safetensors --preset full --clips FOLDER --unfreeze gs_=0,motion_=0.2,...

Needs the rasterizer's library (`raster.py`). `docs/training.md` has the losses and their weights.
"""

import argparse
import time
from pathlib import Path

import torch
from safetensors.torch import load_file

from . import config as cfg
from . import ranks
from .batched import Wanted, forward_clips
from .compose import camera_at, draw, gaussians_at, scene_of
from .data import Chunks, Loader, Sampler, collate, read_clip
from .folders import Folders
from .journal import note, resume, save
from .losses import DYNAMIC
from .optim import Optimizer
from .regular import attenuate, depth_loss, opacity_loss, psnr, rgb_loss, rigid_2d_loss, rigid_3d_loss, symmetry_loss
from .train import learning_rate, step_losses
from .weights import read_model, training_start, write_model


def start_from(path, preset, seed):
    """The model of a checkpoint; with a preset, that network, every tensor of the same name and shape taken over.

    Returns the model and the names that stay as training starts.
    """
    if preset is None:
        return read_model(path), []
    model = training_start(cfg.preset(preset), seed)
    given = load_file(path)
    own = model.state_dict()
    taken = {name: given[name].float() for name in own if name in given and given[name].shape == own[name].shape}
    if not taken:
        raise ValueError(f"{path}: no tensor has the name and shape of one of {preset}'s")
    model.load_state_dict(taken, strict=False)
    return model, sorted(set(own) - set(taken))


class Schedule:
    """Which parameters move when: "gs_=0,point_=0.3" thaws `gs_*` at the start and `point_*` at three tenths."""

    def __init__(self, text):
        self.parts = []
        for part in text.split(","):
            prefix, _, at = part.partition("=")
            self.parts.append((prefix, float(at or 0)))

    def start(self, name):
        """When a parameter thaws; None for never."""
        return next((at for prefix, at in self.parts if name.startswith(prefix)), None)


class Thaw:
    """Holds the parameters that the schedule still freezes: no gradient, no decay, no step."""

    def __init__(self, optimizer, model, schedule):
        self.optimizer, self.parts, at = optimizer, [], 0
        parameters = dict(model.named_parameters())
        for name in optimizer.names:
            p = parameters[name]
            self.parts.append((p, schedule.start(name), slice(at, at + p.numel())))
            at += p.numel()

    def before(self, fraction):
        self.kept = []
        for p, start, where in self.parts:
            p.requires_grad_(start <= fraction)
            if start > fraction:
                self.kept.append((where, self.optimizer.weights[where].clone()))

    def after(self):
        for where, values in self.kept:
            self.optimizer.weights[where] = values


def render_losses(model, batch, context, targets, fraction, args, generator):
    """Losses of a batch: context frames go through the network, target frames are drawn and compared.

    targets: per clip a list of frame numbers; a target between context frames is seen from the camera interpolated between
    theirs, a context frame is drawn without its own dynamic Gaussians.
    """
    config = model.config
    count, frames = len(batch.images), len(context)
    rows = torch.arange(count * frames)
    moving = cfg.has_motion(config)
    wanted = Wanted(depth=rows, gs=rows if config["gs.kind"] != "none" else None)
    if moving:
        wanted.motion = {"fwd": rows, "bwd": rows}
    seen = batch.frames(context)
    raw = forward_clips(model, seen.images, seen.times, wanted)
    stage_one = fraction < args.motion_from
    share = args.opacity_share if fraction < 1 / 3 else 1.0
    size = (batch.images.shape[3], batch.images.shape[2])
    loss = dict.fromkeys(("rgb", "alpha", "depth", "rigid_2d", "rigid_3d", "fb"), 0.0)
    for b in range(count):
        scene = scene_of(raw, b, frames, seen.images[b], seen.times[b], config)
        for frame in targets[b]:
            time_at = batch.times[b, frame].item()
            fields = gaussians_at(scene, time_at, config, own=False, stage_one=stage_one)
            pose, k = camera_at(scene, time_at)
            fields["opacity"] = attenuate(fields["opacity"], share)
            image, depth, _ = draw(fields, pose, k, size, config)
            loss["rgb"] = loss["rgb"] + rgb_loss(image, batch.images[b, frame]) / len(targets[b])
            if frame in context and args.depth:
                f = context.index(frame)
                term = depth_loss(scene.depth[f], depth, (~scene.sky[f]).float())
                loss["depth"] = loss["depth"] + term / len(targets[b])
        loss["alpha"] = loss["alpha"] + opacity_loss(scene.opacity, (~scene.sky).float())
        if moving and not stage_one:
            loss["fb"] = loss["fb"] + symmetry_loss(scene.v_fwd, scene.v_bwd)
            if args.rigid_2d:
                loss["rigid_2d"] = loss["rigid_2d"] + rigid_2d_loss(scene.v_fwd, scene.dynamic)
            if args.rigid_3d:
                term = rigid_3d_loss(scene.mean, scene.v_fwd, scene.dynamic, generator=generator)
                loss["rigid_3d"] = loss["rigid_3d"] + term
    return {name: value / count for name, value in loss.items()}


def choose_targets(batch, context, each, generator):
    """Random frames of every clip from the first to the last context frame."""
    span = range(context[0], context[-1] + 1)
    return [
        [span[i] for i in torch.randperm(len(span), generator=generator)[:each].tolist()] for _ in range(len(batch.images))
    ]


@torch.no_grad()
def drawn_quality(model, records, context, inside, beyond):
    """PSNR of drawn frames between and beyond the context frames, whole and on moving pixels; and of copying the nearest.

    Drawn from predicted cameras, interpolated or carried on, with each context frame's own Gaussians where they are.
    """
    config, sums = model.config, {}
    for record in records:
        batch = collate([read_clip(record)])
        seen = batch.frames(context)
        rows = torch.arange(len(context))
        raw = forward_clips(model, seen.images, seen.times, Wanted(rows, rows, {"fwd": rows, "bwd": rows}))
        scene = scene_of(raw, 0, len(context), seen.images[0], seen.times[0], config)
        size = (batch.images.shape[3], batch.images.shape[2])
        for part, targets in (("inside", inside), ("beyond", beyond)):
            for frame in targets:
                time_at = batch.times[0, frame].item()
                image, _, _ = draw(gaussians_at(scene, time_at, config), *camera_at(scene, time_at), size, config)
                truth = batch.images[0, frame]
                nearest = min(context, key=lambda c: abs(c - frame))
                mask = (batch.velocity[0, frame].norm(dim=-1) > DYNAMIC).float()
                for name, picture in (("drawn", image), ("copy", batch.images[0, nearest])):
                    sums.setdefault(f"{part}_{name}", []).append(psnr(picture, truth).item())
                    if mask.sum() > 50:
                        sums.setdefault(f"{part}_{name}_moving", []).append(psnr(picture, truth, mask).item())
    return {name: sum(values) / len(values) for name, values in sums.items()}


class Run:
    def __init__(self, args, reduce):
        self.args, self.reduce = args, reduce
        self.model, missing = start_from(args.model, args.preset, args.seed)
        schedule = Schedule(args.unfreeze)
        chosen = lambda name: schedule.start(name) is not None  # noqa: E731
        self.optimizer = Optimizer(self.model, chosen, lr=args.lr, muon_lr=2 * args.lr, ema=args.ema)
        self.thaw = Thaw(self.optimizer, self.model, schedule)
        self.samples, self.elapsed = 0, 0.0
        split = self.model.config["render.split"]  # "hard": images teach nothing about what moves
        trained = len(self.optimizer.names)
        note(self.args, event="start", trained=trained, split=split, new=missing[:20], new_count=len(missing))
        resume(self)
        width, height = (int(n) for n in args.size.split("x"))
        self.context = [int(n) for n in args.context.split(",")]
        if args.clips:
            source = Folders(args.clips, width, height, range(args.frames))
        else:
            source = Chunks(args.generator, args.cache, "train", width, height, args.frames, args.stride, 32)
        sampler = Sampler(args.seed, args.window, args.reuse, args.first_clip)
        self.loader = Loader(source, sampler, args.batch, self.samples, args.rank, args.ranks)
        self.records = []
        if args.eval_clips:
            held = Chunks(args.generator, args.cache, "held-out", width, height, max(self.context) + 5, args.stride, 32)
            self.records = [held.clip(i) for i in range(args.eval_clips)][args.rank :: args.ranks]

    def evaluate(self):
        if not self.records:
            return
        inside = [f for f in range(self.context[0], self.context[-1]) if f not in self.context][:: self.args.eval_every]
        beyond = [self.context[-1] + 2, self.context[-1] + 4]
        self.optimizer.swap()
        result = drawn_quality(self.model, self.records, self.context, inside, beyond)
        if self.args.rank == 0:
            write_model(self.args.out / "ema.safetensors", self.model)
        self.optimizer.swap()
        if self.reduce:
            values = torch.tensor(list(result.values()), dtype=torch.float64)
            self.reduce(values)
            result = dict(zip(result, (values / self.args.ranks).tolist()))
        note(self.args, event="eval", samples=self.samples, elapsed=self.elapsed, **result)

    def weigh(self, loss):
        a = self.args
        weights = {"rgb": a.rgb, "alpha": a.alpha, "depth": a.depth, "rigid_2d": a.rigid_2d, "rigid_3d": a.rigid_3d}
        return sum((weights | {"fb": a.fb})[name] * value for name, value in loss.items())

    def train(self):
        args, budget, clock = self.args, 60 * self.args.minutes, torch.zeros(2, dtype=torch.float64)
        began, mean, count = time.time() - self.elapsed, {}, 0
        last = self.elapsed
        self.evaluate()
        while True:
            clock[0], clock[1] = time.time() - began, (args.out / "stop").exists()
            if args.ranks > 1:
                torch.distributed.broadcast(clock, 0)
            self.elapsed = clock[0].item()
            fraction = self.elapsed / budget
            if fraction >= 1 or clock[1] or (args.steps and self.optimizer.steps >= args.steps):
                break
            batch = self.loader.next()
            generator = torch.Generator().manual_seed((args.seed << 40) + (self.samples << 3) + args.rank)
            self.thaw.before(fraction)
            targets = choose_targets(batch, self.context, args.targets, generator)
            loss = render_losses(self.model, batch, self.context, targets, fraction, args, generator)
            total = self.weigh(loss)
            if args.labels:
                _, weighted = step_losses(self.model, batch.frames(self.context), fraction, args, generator)
                total = total + args.labels * sum(weighted.values())
                loss["labels"] = sum(weighted.values())
            total.backward()
            scale = learning_rate(fraction, self.optimizer.steps)
            norm = self.optimizer.step(scale, args.rank, args.ranks, self.reduce)
            self.thaw.after()
            self.samples += args.batch
            count += 1
            for name, value in (loss | {"total": total, "norm": norm}).items():
                mean[name] = mean.get(name, 0.0) + float(torch.as_tensor(value).detach())
            if count % args.log_every == 0:
                entry = {name: value / args.log_every for name, value in mean.items()}
                note(self.args, step=self.optimizer.steps, samples=self.samples, elapsed=self.elapsed, lr=scale, **entry)
                mean = {}
            if self.elapsed - last > 60 * args.eval_minutes:
                save(self)
                self.evaluate()
                last = self.elapsed
        save(self)
        self.evaluate()


def parser():
    p = argparse.ArgumentParser(prog="streetforward.finetune", description=__doc__.splitlines()[0])
    p.add_argument("--model", type=Path, required=True, help="checkpoint to start from")
    p.add_argument("--preset", help="network to train when it is not the checkpoint's: tensors of equal name and shape go over")
    p.add_argument("--out", type=Path, required=True)
    p.add_argument("--cache", type=Path, help="folder for generated clips")
    p.add_argument("--generator", type=Path, help="the clip generator's `stream` example")
    p.add_argument("--clips", type=Path, help="clip folders instead of the generator")
    p.add_argument("--unfreeze", default="gs_=0", help="PREFIX=PART,...: what is trained, and from which part of the schedule")
    p.add_argument("--size", default="168x112")
    p.add_argument("--frames", type=int, default=16, help="frames of a clip")
    p.add_argument("--stride", type=int, default=1, help="tenths of a second between frames")
    p.add_argument("--context", default="0,5,10,15", help="frames that the network sees")
    p.add_argument("--targets", type=int, default=2, help="frames of a clip that are drawn")
    p.add_argument("--minutes", type=float, default=15)
    p.add_argument("--steps", type=int, default=0)
    p.add_argument("--batch", type=int, default=2)
    p.add_argument("--seed", type=int, default=1)
    p.add_argument("--lr", type=float, default=1e-3)
    p.add_argument("--ema", type=float, default=0.99)
    p.add_argument("--first-clip", type=int, default=0, help="number of the first clip; another one, other streets")
    p.add_argument("--window", type=int, default=256)
    p.add_argument("--reuse", type=float, default=4)
    p.add_argument("--rgb", type=float, default=1.0)
    p.add_argument("--alpha", type=float, default=0.03)
    p.add_argument("--depth", type=float, default=0.0)
    p.add_argument("--rigid-2d", type=float, default=0.0)
    p.add_argument("--rigid-3d", type=float, default=0.0)
    p.add_argument("--fb", type=float, default=0.0)
    p.add_argument("--labels", type=float, default=0.0, help="weight of the losses on labels")
    p.add_argument("--opacity-share", type=float, default=0.1, help="what L_rgb does to opacity in the first third")
    p.add_argument("--motion-from", type=float, default=0.0, help="part of the schedule in which nothing travels")
    p.add_argument("--depth-frames", type=int, default=2)
    p.add_argument("--motion-frames", type=int, default=2)
    p.add_argument("--no-matching", dest="matching", action="store_false")
    p.add_argument("--bf16", action="store_true")
    p.add_argument("--eval-clips", type=int, default=8)
    p.add_argument("--eval-every", type=int, default=3, help="every n-th frame between context frames is measured")
    p.add_argument("--eval-minutes", type=float, default=5)
    p.add_argument("--log-every", type=int, default=20)
    ranks.add_arguments(p)
    return p


def main(argv=None):
    args = parser().parse_args(argv)
    if not args.clips and not (args.generator and args.cache):
        raise SystemExit("finetune: give --clips, or --generator and --cache")
    args.out.mkdir(parents=True, exist_ok=True)
    ranks.run("streetforward.finetune", args, argv, lambda reduce: Run(args, reduce).train())


if __name__ == "__main__":
    main()
