"""Held-out measures: what the training log reports and the model card quotes.

    python -m streetforward.evaluate --model nano.safetensors --generator PATH --cache FOLDER
"""

import argparse
import json
from pathlib import Path

import numpy as np
import torch

from . import config as cfg
from .batched import Wanted, forward_clips
from .data import Chunks, collate, held_out, read_clip
from .gaussians import fit_focal
from .losses import DYNAMIC, NEAR, relative


def predict(model, batch):
    """Outputs in the batch's terms: depth [B, F, H, W], sky, relative poses to frame 0, velocity, probability."""
    config = model.config
    b, f = batch.images.shape[:2]
    rows = torch.arange(b * f, device=batch.images.device).view(b, f)
    motion = None
    if cfg.has_motion(config):
        motion = {"fwd": rows[:, :-1].flatten(), "bwd": rows[:, 1:].flatten()}
    raw = forward_clips(model, batch.images, batch.times, Wanted(depth=rows.flatten(), motion=motion))
    shape = batch.depth.shape
    out = {"depth": raw.log_depth(config).exp().view(shape)}
    solid = raw.solid(config)
    out["solid"] = torch.ones_like(out["depth"]) if solid is None else solid.view(shape)
    out["turn"], out["shift"] = (m[:, 0] for m in relative(raw.rotation, raw.translation.double()))
    out["fov"] = raw.fov
    if raw.fov is None:
        points = points_of(raw.depth, config).unflatten(0, (b, f))
        sides = torch.tensor([shape[3], shape[2]], device=points.device)
        out["fov"] = torch.stack([(fit_focal(p, config["camera.k"] == "fit_shared") / sides).log() for p in points])
    if motion is not None:
        ahead = raw.motion["fwd"].view(b, f - 1, *shape[2:], 4)
        behind = raw.motion["bwd"].view(b, f - 1, *shape[2:], 4)
        sign = -config["motion.back_sign"]  # a surface's velocity is minus the backward output's
        last = behind[:, -1:, ..., :3] * sign
        out["velocity"] = torch.cat((ahead[..., :3], last), dim=1) * config["motion.scale"]
        p, q = ((m[..., 3] + config["motion.bias"]).sigmoid() for m in (ahead, behind))
        middle = (p[:, 1:] + q[:, :-1]) / 2
        out["dynamic"] = torch.cat((p[:, :1], middle, q[:, -1:]), dim=1)
    return out


def points_of(raw, config):
    """Local points [..., 3] of a head's (a, b, l) channels."""
    z = raw[..., -1:].exp()
    return torch.cat((raw[..., :2] * z, z), dim=-1)


class Sums:
    """Running sums by name; a measure is a quotient of two. Ranks add their sums before dividing."""

    NAMES = (
        "pixels relative scaled close sky_and sky_or pairs turn shift travel moved direction fov clips "
        "moving epe gated speed crossing_epe crossing_speed still false_speed dyn_and dyn_or false_dynamic"
    ).split()

    def __init__(self):
        self.value = dict.fromkeys(self.NAMES, 0.0)

    def add(self, **values):
        for name, value in values.items():
            self.value[name] += float(value)

    def tensor(self):
        return torch.tensor([self.value[n] for n in self.NAMES], dtype=torch.float64)

    def load(self, tensor):
        self.value = dict(zip(self.NAMES, tensor.tolist()))

    def measures(self):
        v = self.value

        def ratio(a, b):
            return v[a] / v[b] if v[b] else float("nan")

        return {
            "abs_rel": ratio("relative", "pixels"),
            "abs_rel_scaled": ratio("scaled", "pixels"),
            "under_1.25": ratio("close", "pixels"),
            "sky_iou": ratio("sky_and", "sky_or"),
            "rotation_deg": ratio("turn", "pairs"),
            "travel_error_m": ratio("shift", "pairs"),
            "travel_m": ratio("travel", "pairs"),
            "direction_deg": ratio("direction", "moved"),
            "log_focal": ratio("fov", "clips"),
            "epe_ratio": ratio("epe", "speed"),
            "epe_ratio_gated": ratio("gated", "speed"),
            "epe_ratio_crossing": ratio("crossing_epe", "crossing_speed"),
            "mean_speed": ratio("speed", "moving"),
            "false_speed": ratio("false_speed", "still"),
            "false_dynamic": ratio("false_dynamic", "still"),
            "dynamic_iou": ratio("dyn_and", "dyn_or"),
        }


def measure(sums, out, batch):
    """Adds one batch. Speeds under the mask count as zero (gated), as the renderer treats them."""
    solid = batch.depth > 0
    near = solid & (batch.depth < NEAR)
    for depth, truth, mask in zip(out["depth"].flatten(0, 1), batch.depth.flatten(0, 1), near.flatten(0, 1)):
        d, t = depth[mask], truth[mask]
        if len(t) == 0:
            continue
        scale = (t / d).median()
        sums.add(pixels=len(t), relative=((d - t).abs() / t).sum(), scaled=((d * scale - t).abs() / t).sum())
        sums.add(close=(torch.maximum(d / t, t / d) < 1.25).sum())
    sky = out["solid"] < 0
    sums.add(sky_and=(sky & ~solid).sum(), sky_or=(sky | ~solid).sum())

    turn, shift = (m[:, 0] for m in relative(batch.pose[..., :3, :3], batch.pose[..., :3, 3]))
    between = turn.mT @ out["turn"]
    # asin of half the chord is exact near zero, where acos of the trace is not.
    chord = (between - torch.eye(3, dtype=between.dtype, device=between.device)).norm(dim=(-2, -1)) / 8**0.5
    angle = 2 * torch.asin(chord.clamp(max=1)).rad2deg()
    travel = shift.norm(dim=-1)
    sums.add(pairs=angle[:, 1:].numel(), turn=angle[:, 1:].sum(), travel=travel[:, 1:].sum())
    sums.add(shift=(out["shift"] - shift).norm(dim=-1)[:, 1:].sum())
    moved = travel > 0.5
    cosine = torch.nn.functional.cosine_similarity(out["shift"], shift, dim=-1).clamp(-1, 1)
    sums.add(moved=moved.sum(), direction=cosine.acos().rad2deg()[moved].sum())
    width = batch.images.shape[3]
    sums.add(clips=len(travel), fov=(out["fov"][..., 0].mean(1) - (batch.focal[:, 0] / width).log()).abs().sum())

    if "velocity" not in out:
        return
    speed = batch.velocity.norm(dim=-1)
    moving = speed > DYNAMIC
    called = out["dynamic"] > 0.5
    error = (out["velocity"] - batch.velocity).norm(dim=-1)
    gated = torch.where(called, error, speed)
    sums.add(moving=moving.sum(), epe=error[moving].sum(), gated=gated[moving].sum(), speed=speed[moving].sum())
    crossing = moving & (batch.velocity[..., 0].abs() > batch.velocity[..., 2].abs())
    sums.add(crossing_epe=gated[crossing].sum(), crossing_speed=speed[crossing].sum())
    still = ~moving & solid
    false = torch.where(called, out["velocity"].norm(dim=-1), torch.zeros_like(speed))
    sums.add(still=still.sum(), false_speed=false[still].sum(), false_dynamic=(called & still).sum())
    sums.add(dyn_and=(called & moving).sum(), dyn_or=(called | moving).sum())


@torch.no_grad()
def evaluate(model, records, device="cpu", batch=4, rank=0, ranks=1, reduce=None):
    """Measures over records; each rank takes its share and all get the result."""
    sums = Sums()
    mine = records[rank::ranks]
    for i in range(0, len(mine), batch):
        clips = collate([read_clip(record) for record in mine[i : i + batch]]).to(device)
        measure(sums, predict(model, clips), clips)
    if ranks > 1:
        total = sums.tensor()
        reduce(total)
        sums.load(total)
    return sums.measures()


def colour_map(x):
    """0..1 to a map from dark blue over green to yellow, [..., 3] u8."""
    x = np.clip(x, 0, 1)[..., None]
    stops = np.array([[40, 20, 90], [40, 90, 160], [40, 160, 130], [130, 205, 70], [250, 230, 40]], float)
    at = x * (len(stops) - 1)
    low = np.clip(at.astype(int), 0, len(stops) - 2)
    part = at - low
    return ((1 - part) * stops[low[..., 0]] + part * stops[low[..., 0] + 1]).astype(np.uint8)


@torch.no_grad()
def picture(model, records, path, device="cpu", frame=1):
    """A sheet, one row a clip: image, depth truth and prediction, speed truth and prediction, mask truth and prediction."""
    from PIL import Image

    rows = []
    for record in records:
        batch = collate([read_clip(record)]).to(device)
        out = {key: value.cpu() for key, value in predict(model, batch).items()}
        batch = batch.to("cpu")

        def inverse(depth, solid):
            near = np.where(solid, 3 / np.maximum(depth, 3), 0)
            return colour_map(near**0.5)

        depth, truth = out["depth"][0, frame].numpy(), batch.depth[0, frame].numpy()
        tiles = [(batch.images[0, frame].numpy() * 255).astype(np.uint8)]
        tiles += [inverse(truth, truth > 0), inverse(depth, out["solid"][0, frame].numpy() > 0)]
        if "velocity" in out:
            probability = out["dynamic"][0, frame].numpy()
            speed = batch.velocity[0, frame].norm(dim=-1).numpy()
            predicted = out["velocity"][0, frame].norm(dim=-1).numpy() * (probability > 0.5)
            tiles += [colour_map(speed / 12), colour_map(predicted / 12)]
            tiles += [colour_map(speed > DYNAMIC), colour_map(probability)]
        rows.append(np.concatenate(tiles, axis=1))
    Image.fromarray(np.concatenate(rows)).save(path)


def main(argv=None):
    from .weights import read_model

    parser = argparse.ArgumentParser(prog="streetforward.evaluate", description=__doc__.splitlines()[0])
    parser.add_argument("--model", type=Path, required=True, help="checkpoint (.safetensors)")
    parser.add_argument("--generator", type=Path, required=True, help="the clip generator's `stream` example")
    parser.add_argument("--cache", type=Path, required=True, help="folder for generated clips")
    parser.add_argument("--clips", type=int, default=128)
    parser.add_argument("--size", default="168x112")
    parser.add_argument("--picture", type=Path, help="also draw a sheet of eight clips")
    args = parser.parse_args(argv)
    width, height = (int(n) for n in args.size.split("x"))
    records = held_out(Chunks(args.generator, args.cache, "held-out", width, height), args.clips)
    model = read_model(args.model)
    if args.picture:
        picture(model, records[:8], args.picture)
    print(json.dumps(evaluate(model, records), indent=1))


if __name__ == "__main__":
    main()
