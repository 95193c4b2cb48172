"""The network with fixed sizes, for exporters: every table a constant, outputs as the heads give them.

    python -m streetforward.graph nano.safetensors --frames 4 --size 252x168 -o nano.onnx

Same weights and numbers as `model.py` up to the raw maps; what follows them (nearest rotation, focal length, Gaussian and
motion maps: no weights) is `finish`, in plain PyTorch. Three savings that the engine makes are made here too, so that a
runtime is not judged on work it need not do: masked attention visits only the frames in sight, both causal passes
share the first layer's q|k|v, and motion maps that nobody reads are not computed.
"""

import argparse
import sys
from contextlib import contextmanager
from functools import lru_cache
from pathlib import Path

import torch
import torch.nn.functional as F
from safetensors import safe_open
from torch import nn

from . import config as cfg
from . import gaussians as g
from . import heads
from .aggregator import last_features
from .blocks import Rope, patch_positions
from .causal import pass_ranges, time_embedding
from .encoder import resize_positions
from .heads import nearest_rotation
from .weights import read_model

OPSET = 18


class FixedRope(nn.Module):
    """`Rope` with its tables as f32 constants."""

    def __init__(self, positions, head_dim, config):
        super().__init__()
        rope = Rope(positions, head_dim, config)
        self.register_buffer("cos", rope.cos.float(), persistent=False)
        self.register_buffer("sin", rope.sin.float(), persistent=False)

    def forward(self, x):
        cos, sin = self.cos.to(x.dtype), self.sin.to(x.dtype)
        first, second = x.unflatten(-1, (2, 2, -1)).unbind(-2)
        return torch.stack((first * cos - second * sin, second * cos + first * sin), dim=-2).flatten(-3)


def sight(frames, lo, hi):
    """Neighbouring frames that see equally many frames at equal offsets: [(first, end, offsets)]."""
    groups = []
    for f in range(frames):
        offsets = [o for o in range(lo, hi + 1) if 0 <= f + o < frames]
        if groups and groups[-1][2] == offsets:
            groups[-1][1] = f + 1
        else:
            groups.append([f, f + 1, offsets])
    return groups


def attend(q, k, v, groups):
    """q, k, v [F, heads, N, d]; whole frames in sight are the keys of a query; 0 where a query sees none."""
    parts = []
    for first, end, offsets in groups:
        if not offsets:
            parts.append(torch.zeros_like(q[first:end]))
            continue
        keys, values = (torch.cat([t[first + o : end + o] for o in offsets], dim=2) for t in (k, v))
        parts.append(F.scaled_dot_product_attention(q[first:end], keys, values))
    return torch.cat(parts).transpose(1, 2).flatten(2)


class Graph(nn.Module):
    """(images u8 [F, H, W, 3], time [F, d_t]) to the raw maps named by `names`.

    Needs `motion.layout` per_direction or no motion; the configuration decides everything else.
    """

    def __init__(self, model, frames, height, width):
        super().__init__()
        self.model, config = model, model.config
        if cfg.has_motion(config) and config["motion.layout"] != "per_direction":
            raise ValueError("motion.layout = single_pass has no fixed graph")
        patch = config["patch"]
        if height % patch or width % patch:
            raise ValueError(f"{width}x{height}: sides must be multiples of {patch}")
        self.frames, self.grid, self.size = frames, (height // patch, width // patch), (height, width)
        positions = patch_positions(*self.grid, config["aa.registers"])
        alone = patch_positions(*self.grid)
        head_dim = config["aa.dim"] // config["aa.heads"]
        self.inside = FixedRope(positions, head_dim, config)
        self.across = FixedRope(positions.repeat(frames, 1), head_dim, config)
        self.moving = cfg.has_motion(config) and frames > 1
        if self.moving:
            seen = positions if config["causal.registers"] else alone
            self.over_time = FixedRope(seen, cfg.causal_dim(config) // config["causal.heads"], config)
        with torch.no_grad():
            places = resize_positions(model.encoder.pos_embed[0], *self.grid)
        self.register_buffer("places", places.clone(), persistent=False)
        for key in ("mean", "std"):
            value = 255 * torch.tensor(config[f"image.{key}"])
            self.register_buffer(key, value[:, None, None], persistent=False)
        self.names = ["t", "nine"] + (["fov"] if config["camera.k"] == "fov" else []) + ["point"]
        if config["depth.out_map"] == "exp_z_conf" or config["conf.kind"] != "none":
            self.names.append("conf")
        self.names += ["gs"] if config["gs.kind"] != "none" else []
        self.names += ["fwd", "bwd"] if self.moving else []

    def read(self, way):
        """Frames (first, end) whose motion map of a pass is read: the others mirror the other direction."""
        config, n = self.model.config, self.frames
        if config["render.extrapolate"] != "mirror":
            return 0, n
        ahead = pass_ranges(config)[way][1] > 0
        return (0, n - 1) if ahead else (1, n)

    def forward(self, images, time):
        model, config = self.model, self.model.config
        normal = (images.permute(0, 3, 1, 2).to(self.places.dtype) - self.mean) / self.std
        tokens = self.encode(normal)
        if config["aa.time"]:
            tokens = tokens + model.aa_time(time)[:, None]
        layers, x = [], tokens
        parity = 1 if config["aa.order"] == "frame_first" else 0
        for i, block in enumerate(model.decoder):
            if i % 2 == parity:
                x = block(x.flatten(0, 1)[None], self.across).reshape(x.shape)
            else:
                x = block(x, self.inside)
            layers.append(x)
        guide = model.image_stem(normal) if cfg.guided(config) else None

        camera = last_features(layers, config["head.concat"])
        t, nine, fov = model.camera_head(self.decode(model.camera_decoder, camera, self.inside_of(config["camera.dim"], "camera")))
        out = [t, nine] + ([fov] if fov is not None else [])
        raw = self.dense("point", "depth", layers, guide)
        conf = None
        if config["depth.out_map"] == "exp_z_conf":
            raw, conf = raw[..., :1], raw[..., 1]
        elif config["conf.kind"] != "none":
            conf = self.dense("conf", "conf", layers, guide)[..., 0]
        out.append(model.points(raw))
        out += [conf] if conf is not None else []
        if config["gs.kind"] != "none":
            out.append(self.dense("gs", "gs", layers, guide))
        if self.moving:
            out += self.motion(layers, time, guide)
        return tuple(out)

    def encode(self, normal):
        encoder, frames = self.model.encoder, self.frames
        x = torch.cat((encoder.cls_token.expand(frames, -1, -1), encoder.patch_embed(normal)), dim=1) + self.places
        special = 1
        if encoder.register_tokens is not None:
            registers = encoder.register_tokens.expand(frames, -1, -1)
            x, special = torch.cat((x[:, :1], registers, x[:, 1:]), dim=1), 1 + registers.shape[1]
        for block in encoder.blocks:
            x = block(x)
        x = encoder.norm(x)[:, special:]
        registers = self.model.register_token
        return x if registers is None else torch.cat((registers[0].expand(frames, -1, -1), x), dim=1)

    def inside_of(self, dim, prefix, registers=True):
        """Rotary tables of a decoder's blocks (made when first asked for, before anything is traced)."""
        key = f"rope_{prefix}_{int(registers)}"
        if not hasattr(self, key):
            count = self.model.config["aa.registers"] if registers else 0
            positions = patch_positions(*self.grid, count)
            setattr(self, key, FixedRope(positions, dim // self.model.config[f"{prefix}.heads"], self.model.config))
        return getattr(self, key)

    def decode(self, decoder, tokens, rope):
        """Patch tokens [F, P, out]."""
        x = decoder.projects(tokens)
        for block in decoder.blocks:
            x = block(x, rope)
        return decoder.linear_out(x)[:, x.shape[1] - self.grid[0] * self.grid[1] :]

    def dense(self, name, prefix, layers, guide):
        config, registers = self.model.config, self.model.config["aa.registers"]
        head = getattr(self.model, f"{name}_head")
        if config[f"{prefix}.kind"] == "dpt":
            pairs = [torch.cat(layers[2 * j : 2 * j + 2], dim=-1)[:, registers:] for j in config[f"{prefix}.taps"]]
            return head(pairs, self.grid, config["patch"])
        tokens = last_features(layers, config["head.concat"])
        rope = self.inside_of(config[f"{prefix}.dim"], prefix)
        tokens = self.decode(getattr(self.model, f"{name}_decoder"), tokens, rope)
        return head(tokens, self.grid, guide) if config[f"{prefix}.kind"] == "guided" else head(tokens, self.grid)

    def motion(self, layers, time, guide):
        model, config = self.model, self.model.config
        tokens = last_features(layers, config["causal.in"])
        if not config["causal.registers"]:
            tokens = tokens[:, config["aa.registers"] :]
        tokens = torch.cat((tokens, time[:, None].expand(-1, tokens.shape[1], -1)), dim=-1)
        patches = self.grid[0] * self.grid[1]
        shared = self.qkv(model.causal[0], tokens) if config["causal.share"] else None
        maps = []
        for way, reach in pass_ranges(config).items():
            blocks = model.causal_back if way == "bwd" and not config["causal.share"] else model.causal
            groups, x, outputs = sight(self.frames, *reach), tokens, []
            for i, block in enumerate(blocks):
                q, k, v = shared if i == 0 and shared is not None else self.qkv(block, x)
                x = x + block.ls1(block.attn.proj(attend(q, k, v, groups)))
                x = x + block.ls2(block.mlp(block.norm2(x)))
                outputs.append(x[:, x.shape[1] - patches :])
            first, end = self.read(way)
            outputs = [o[first:end] for o in outputs]
            if config["motion.kind"] == "dpt":
                maps.append(model.motion_head([outputs[j] for j in config["motion.taps"]], self.grid, config["patch"]))
                continue
            rope = self.inside_of(config["motion.dim"], "motion", registers=False)
            decoded = self.decode(model.motion_decoder, outputs[-1], rope)
            if config["motion.kind"] == "guided":
                maps.append(model.motion_head(decoded, self.grid, guide[first:end]))
            else:
                maps.append(model.motion_head(decoded, self.grid))
        return maps

    def qkv(self, block, x):
        """Normed, turned q, k and v [F, heads, N, d] of a causal block."""
        attn = block.attn
        q, k, v = attn.qkv(block.norm1(x)).unflatten(-1, (3, attn.heads, -1)).permute(2, 0, 3, 1, 4)
        if hasattr(attn, "q_norm"):
            q, k = attn.q_norm(q), attn.k_norm(k)
        return self.over_time(q), self.over_time(k), v


def finish(raw, images, times, config):
    """The network's outputs, named as `StreetForward` names them, from the raw maps of `Graph` (name -> tensor)."""
    raw = {name: torch.as_tensor(value).float() for name, value in raw.items()}
    k = g.intrinsics(raw["point"], raw.get("fov"), config)
    pose = g.anchored_poses(g.raw_poses(nearest_rotation(raw["nine"]), raw["t"]), config)
    depth = raw["point"][..., -1]
    scene = depth * config["world.scale"]
    image = images.float() / 255
    out = {"pose": pose, "depth": scene, "mean": g.unproject(scene, k, pose, config)}
    if "gs" in raw:
        maps = g.gaussian_maps(raw["gs"], image, depth, k, pose, config)
        out |= dict(zip(("colour", "opacity", "scale", "quat"), maps))
    if "fwd" in raw:
        whole, frames = {}, len(times)
        for way in ("fwd", "bwd"):  # unread maps come back as zeros: nothing looks at them
            part = raw[way]
            whole[way] = part.new_zeros(frames, *part.shape[1:])
            late = way == "bwd" and len(part) < frames
            early = way == "fwd" and len(part) < frames
            if config["mask.orientation"] == "figure":
                late, early = early, late
            whole[way][(1 if late else 0) : (frames - 1 if early else frames)] = part
        out |= dict(zip(("v_fwd", "v_bwd", "dynamic"), g.motion_maps(whole, times, pose, config)))
    return out


@contextmanager
def constants():
    """The position maps of pyramids as constants, computed once."""
    plain = heads.uv_embedding
    cached = lru_cache(maxsize=None)(lambda c, size, aspect: plain(c, size, aspect).float())
    heads.uv_embedding = lambda c, size, aspect: cached(int(c), tuple(int(n) for n in size), aspect)
    try:
        yield
    finally:
        heads.uv_embedding = plain


def inputs(config, images, times):
    """What `Graph` takes: images, and the time embedding in f32."""
    width = config["time.d_t"]
    time = time_embedding(times, config).float() if width else torch.zeros(len(times), 1)
    return images, time


def read_config(path):
    """The configuration that a checkpoint carries."""
    with safe_open(path, "pt") as file:
        return cfg.from_json((file.metadata() or {})[cfg.METADATA_KEY])


def export_onnx(graph, path):
    """Writes the graph; weights of more than 2 GB lie beside it in `path`.data."""
    config = graph.model.config
    images = torch.zeros(graph.frames, *graph.size, 3, dtype=torch.uint8)
    times = torch.arange(graph.frames, dtype=torch.float64)
    args = inputs(config, images, times)
    names = ["images", "time"]
    with torch.no_grad(), constants():
        graph.eval()
        graph(*args)  # makes the tables
        torch.onnx.export(
            graph, args, str(path), input_names=names, output_names=graph.names, opset_version=OPSET, dynamo=False
        )


def main(argv=None):
    parser = argparse.ArgumentParser(prog="streetforward.graph", description=__doc__.splitlines()[0])
    parser.add_argument("model", type=Path, help="checkpoint (.safetensors)")
    parser.add_argument("--frames", type=int, default=4)
    parser.add_argument("--size", default="252x168", help="WxH")
    parser.add_argument("-o", "--output", type=Path, required=True)
    args = parser.parse_args(argv)
    width, height = (int(n) for n in args.size.split("x"))
    graph = Graph(read_model(args.model), args.frames, height, width)
    export_onnx(graph, args.output)
    print(f"{args.output}: outputs {', '.join(graph.names)}")


if __name__ == "__main__":
    sys.exit(main())
