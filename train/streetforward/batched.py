"""The network over a batch of clips, for training: raw head outputs of chosen frames, in the parameters' precision.

The same modules and numbers as `model.py`, which stays the readable definition; a test compares the two. Frame-local
layers see all frames of all clips as one batch, global layers one row per clip, and a dense head runs only on the frames
that a loss wants: frames of a clip resemble each other, so half of them teach almost as much for half the price.
"""

from dataclasses import dataclass, field

import torch

from .aggregator import last_features
from .blocks import Rope, patch_positions
from .causal import frame_mask, pass_ranges, time_embedding
from .heads import nearest_rotation


@dataclass
class Wanted:
    """Frames, as row numbers of the flattened [B * F], that each dense head computes; None leaves a head out."""

    depth: torch.Tensor | None = None
    gs: torch.Tensor | None = None
    motion: dict | None = None  # {"fwd": rows, "bwd": rows}


@dataclass
class Raw:
    """What `forward_clips` returns; dense maps are [rows, H, W, out]."""

    translation: torch.Tensor  # [B, F, 3]
    rotation: torch.Tensor  # [B, F, 3, 3]
    fov: torch.Tensor | None  # [B, F, 2], ln of the focal lengths over the image's sides
    depth: torch.Tensor | None = None
    conf: torch.Tensor | None = None  # of the frames of `depth`, where the network has such a head
    gs: torch.Tensor | None = None
    motion: dict = field(default_factory=dict)
    kept: list = field(default_factory=list)  # (name, queries, keys) [B, F, P, d] of attention heads under supervision
    tokens: dict = field(default_factory=dict)  # patch tokens [B, F, P, C] after the layers that answer for displacement

    def log_depth(self, config):
        """[rows, H, W]"""
        return self.depth[..., 0 if config["depth.out_map"] == "exp_z_conf" else -1]

    def solid(self, config):
        """Logit that a pixel is not sky [rows, H, W], or None."""
        if config["depth.out_map"] == "exp_z_conf":
            return self.depth[..., 1]
        return None if self.conf is None else self.conf[..., 0]


class Nearest(torch.autograd.Function):
    """`nearest_rotation` with a gradient that stays finite at the identity.

    With M = R P, P symmetric: dR = R [w]x and (tr(P) I - P) w = axial(R^T dM); the singular vectors, which are free
    where singular values meet, do not enter.
    """

    @staticmethod
    def forward(ctx, m):
        r = nearest_rotation(m.flatten(-2))
        ctx.save_for_backward(m, r)
        return r

    @staticmethod
    def backward(ctx, grad):
        m, r = ctx.saved_tensors
        p = r.mT @ m
        p = (p + p.mT) / 2
        eye = torch.eye(3, dtype=m.dtype, device=m.device)
        k = p.diagonal(dim1=-2, dim2=-1).sum(-1)[..., None, None] * eye - p
        # Two singular values that cancel (a reflection) leave a direction undetermined: no step along it.
        w = torch.linalg.pinv(k, hermitian=True, rtol=1e-3) @ axial(r.mT @ grad)[..., None]
        return r @ cross_matrix(w[..., 0])


def axial(a):
    """The vector of a matrix's antisymmetric part, doubled."""
    return torch.stack((a[..., 2, 1] - a[..., 1, 2], a[..., 0, 2] - a[..., 2, 0], a[..., 1, 0] - a[..., 0, 1]), dim=-1)


def cross_matrix(w):
    x, y, z = w.unbind(-1)
    o = torch.zeros_like(x)
    return torch.stack((o, -z, y, z, o, -x, -y, x, o), dim=-1).unflatten(-1, (3, 3))


def rotations(nine):
    """Rotations [..., 3, 3] in f64 of rotation numbers [..., 9], differentiable; equal to `nearest_rotation`."""
    m = nine.to(torch.float64).unflatten(-1, (3, 3))
    return Nearest.apply(m / m.norm(dim=-1, keepdim=True).clamp_min(1e-12))


def full(x):
    """What autocast left in bf16 as f32."""
    return x.float() if x.dtype == torch.bfloat16 else x


def forward_clips(model, images, times, wanted, keep=(), tokens_of=()):
    """images [B, F, H, W, 3] in 0..1, times f64 [B, F].

    `keep` names attention modules ("decoder.1", "causal.0") whose first head's queries and keys come back, `tokens_of`
    layers ("decoder.5", "causal.1": both passes) whose patch tokens do.
    """
    config = model.config
    batch, frames, height, width, _ = images.shape
    grid = height // config["patch"], width // config["patch"]
    registers = config["aa.registers"]
    for name in keep:
        model.get_submodule(name).attn.keep = True

    mean, std = (torch.tensor(config[f"image.{key}"]).to(images) for key in ("mean", "std"))
    normal = ((images.flatten(0, 1) - mean) / std).permute(0, 3, 1, 2)  # channels last as it stands
    patches = model.encoder(normal, lambda _, tensor: tensor)
    time = None
    if config["time.d_t"]:
        time = torch.stack([time_embedding(t, config) for t in times]).flatten(0, 1).to(patches.dtype)

    tokens = patches
    if model.register_token is not None:
        tokens = torch.cat((model.register_token[0].expand(len(patches), -1, -1), patches), dim=1)
    if config["aa.time"]:
        tokens = tokens + model.aa_time(time)[:, None].to(tokens.dtype)
    layers = alternate_clips(model, tokens, batch, frames, grid)

    features = last_features(layers, config["head.concat"])
    camera = model.camera_decoder(features, grid, registers, config)
    with torch.autocast(images.device.type, enabled=False):
        translation, nine, fov = model.camera_head(full(camera))
    raw = Raw(
        translation.unflatten(0, (batch, frames)),
        rotations(nine.unflatten(0, (batch, frames))),
        None if fov is None else fov.unflatten(0, (batch, frames)),
    )

    guide = model.image_stem(normal) if hasattr(model, "image_stem") else None

    def dense(name, prefix, layers, rows, registers):
        head = getattr(model, f"{name}_head")
        taps = config[f"{prefix}.taps"]
        if config[f"{prefix}.kind"] == "dpt":
            if prefix != "motion":  # pairs of a frame and a global layer
                layers = [torch.cat(layers[2 * j : 2 * j + 2], dim=-1) if j in taps else None for j in range(len(layers) // 2)]
            return full(head([layers[j][rows, registers:] for j in taps], grid, config["patch"]))
        tokens = layers[-1] if prefix == "motion" else last_features(layers, config["head.concat"])
        tokens = getattr(model, f"{name}_decoder")(tokens[rows], grid, registers, config)
        if config[f"{prefix}.kind"] == "guided":
            return full(head(tokens, grid, guide[rows]))
        return full(head(tokens, grid))

    if wanted.depth is not None:
        raw.depth = dense("point", "depth", layers, wanted.depth, registers)
        if config["conf.kind"] != "none":
            raw.conf = dense("conf", "conf", layers, wanted.depth, registers)
    if wanted.gs is not None:
        raw.gs = dense("gs", "gs", layers, wanted.gs, registers)
    if wanted.motion is not None:
        for way, outputs in causal_clips(model, layers, time, batch, frames, grid, raw.kept).items():
            raw.motion[way] = dense("motion", "motion", outputs, wanted.motion[way], 0)
            for i, output in enumerate(outputs):
                if f"causal.{i}" in tokens_of:
                    raw.tokens[f"causal.{way}.{i}"] = output.unflatten(0, (batch, frames))
    for i, layer in enumerate(layers):
        if f"decoder.{i}" in tokens_of:
            raw.tokens[f"decoder.{i}"] = layer[:, registers:].unflatten(0, (batch, frames))
    for name in keep:
        attention = model.get_submodule(name).attn
        attention.keep = False
        if name.startswith("decoder."):
            q, k = (t.unflatten(1, (frames, -1))[:, :, registers:] for t in attention.kept)
            raw.kept.append((name, q, k))
    return raw


def alternate_clips(model, tokens, batch, frames, grid):
    """Tokens [B F, T, C] through the alternating stack; every layer's output."""
    config = model.config
    positions = patch_positions(*grid, config["aa.registers"]).to(tokens.device)
    head_dim = config["aa.dim"] // config["aa.heads"]
    inside, across = Rope(positions, head_dim, config), Rope(positions.repeat(frames, 1), head_dim, config)
    global_parity = 1 if config["aa.order"] == "frame_first" else 0
    outputs, x = [], tokens
    for i, block in enumerate(model.decoder):
        if i % 2 == global_parity:
            x = block(x.reshape(batch, -1, x.shape[-1]), across).reshape(x.shape)
        else:
            x = block(x, inside)
        outputs.append(x)
    return outputs


def causal_clips(model, layers, time, batch, frames, grid, kept):
    """Patch tokens [B F, P, D'] after every causal layer of each pass."""
    config = model.config
    if config["causal.registers"] or config["motion.layout"] != "per_direction":
        raise ValueError("training in batches needs causal.registers = false and motion.layout = per_direction")
    tokens = last_features(layers, config["causal.in"])[:, config["aa.registers"] :]
    tokens = torch.cat((tokens, time[:, None].expand(-1, tokens.shape[1], -1).to(tokens.dtype)), dim=-1)
    length, dim = tokens.shape[1:]
    positions = patch_positions(*grid).repeat(frames, 1).to(tokens.device)
    rope = Rope(positions, dim // config["causal.heads"], config)
    result = {}
    for way, reach in pass_ranges(config).items():
        blocks = model.causal_back if way == "bwd" and not config["causal.share"] else model.causal
        mask = frame_mask(frames, *reach).to(tokens.device)
        mask = mask.repeat_interleave(length, 0).repeat_interleave(length, 1)
        x, result[way] = tokens.reshape(batch, frames * length, dim), []
        for i, block in enumerate(blocks):
            x = block(x, rope, mask)
            if block.attn.keep:
                q, k = (t.unflatten(1, (frames, length)) for t in block.attn.kept)
                kept.append((f"causal.{way}.{i}", q, k))
            result[way].append(x.reshape(batch * frames, length, dim))
    return result
