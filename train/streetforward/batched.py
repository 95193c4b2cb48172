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
    fov: torch.Tensor  # [B, F, 2], ln of the focal lengths over the image's sides
    depth: torch.Tensor | None = None
    gs: torch.Tensor | None = None
    motion: dict = field(default_factory=dict)
    kept: list = field(default_factory=list)  # (name, queries, keys) [B, F, P, d] of attention heads under supervision


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


def forward_clips(model, images, times, wanted, keep=()):
    """images [B, F, H, W, 3] in 0..1, times f64 [B, F].

    `keep` names attention modules ("decoder.1", "causal.0") whose first head's queries and keys come back.
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
        translation, nine, fov = model.camera_head(camera.float())
    raw = Raw(
        translation.unflatten(0, (batch, frames)),
        rotations(nine.unflatten(0, (batch, frames))),
        None if fov is None else fov.unflatten(0, (batch, frames)),
    )

    guide = model.image_stem(normal) if hasattr(model, "image_stem") else None

    def dense(name, prefix, tokens, rows, registers):
        tokens = getattr(model, f"{name}_decoder")(tokens, grid, registers, config)
        head = getattr(model, f"{name}_head")
        if config[f"{prefix}.kind"] == "guided":
            return head(tokens, grid, guide[rows]).float()
        return head(tokens, grid).float()

    if wanted.depth is not None:
        raw.depth = dense("point", "depth", features[wanted.depth], wanted.depth, registers)
    if wanted.gs is not None:
        raw.gs = dense("gs", "gs", features[wanted.gs], wanted.gs, registers)
    if wanted.motion is not None:
        for way, tokens in causal_clips(model, layers, time, batch, frames, grid, raw.kept).items():
            rows = wanted.motion[way]
            raw.motion[way] = dense("motion", "motion", tokens[rows], rows, 0)
    for name in keep:
        attention = model.get_submodule(name).attn
        attention.keep = False
        if name.startswith("decoder."):
            q, k = (t.unflatten(1, (frames, -1))[:, :, registers:] for t in attention.kept)
            raw.kept.append((name, q, k))
    return raw


def alternate_clips(model, tokens, batch, frames, grid):
    """Tokens [B F, T, C] through the alternating stack; the outputs of its last two layers."""
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
    return outputs[-2:]


def causal_clips(model, layers, time, batch, frames, grid, kept):
    """Patch tokens [B F, P, D'] after the last causal layer of each pass."""
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
        x = tokens.reshape(batch, frames * length, dim)
        for i, block in enumerate(blocks):
            x = block(x, rope, mask)
            if block.attn.keep:
                q, k = (t.unflatten(1, (frames, length)) for t in block.attn.kept)
                kept.append((f"causal.{way}.{i}", q, k))
        result[way] = x.reshape(batch * frames, length, dim)
    return result
