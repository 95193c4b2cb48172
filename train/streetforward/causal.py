"""The causal module: masked attention over time on features joined with a time embedding."""

import torch
from torch import nn

from . import config as cfg
from .blocks import Block, Rope, patch_positions


def time_embedding(times, config):
    """times [F] in seconds to [F, d_t] in f64: sines then cosines of p w_i.

    p = (t - t_0) / unit and w_i = base^(-i / (d_t / 2)).
    """
    half = config["time.d_t"] // 2
    phase = (times - times[0]) / config["time.unit"]
    omega = config["time.base"] ** (-torch.arange(half, dtype=torch.float64, device=times.device) / half)
    angle = phase[:, None] * omega
    return torch.cat((angle.sin(), angle.cos()), dim=-1)


def causal_blocks(config):
    return nn.ModuleList(
        Block(
            cfg.causal_dim(config),
            config["causal.heads"],
            eps=config["aa.eps"],
            qk_eps=config["aa.qk_eps"],
            scale=0.01,
        )
        for _ in range(config["causal.depth"])
    )


def pass_ranges(config):
    """Passes and their masks: {"fwd": (lo, hi), "bwd": (lo, hi)}; frame f sees the frames f + lo .. f + hi."""
    k = config["mask.k"]
    if config["motion.layout"] == "single_pass":
        return {"fwd": (-k, k)}
    nearest = 0 if config["mask.self"] else 1
    ahead, behind = (nearest, k), (-k, -nearest)
    if config["mask.orientation"] == "figure":
        ahead, behind = behind, ahead
    return {"fwd": ahead, "bwd": behind}


def frame_mask(frames, lo, hi):
    """[F, F] true where the row's frame sees the column's."""
    f = torch.arange(frames)
    step = f[None, :] - f[:, None]
    return (step >= lo) & (step <= hi)


def run_pass(blocks, tokens, reach, grid, config):
    """One pass over tokens [F, N, D'] with the mask of `reach` = (lo, hi).

    The patch tokens after every layer, each [F, P, D']. The dense mask is for clarity: it is (F N)^2.
    """
    frames, length, dim = tokens.shape
    registers = length - grid[0] * grid[1]
    positions = patch_positions(*grid, registers).repeat(frames, 1).to(tokens.device)
    rope = Rope(positions, dim // config["causal.heads"], config)
    mask = frame_mask(frames, *reach).to(tokens.device)
    mask = mask.repeat_interleave(length, 0).repeat_interleave(length, 1)

    outputs, x = [], tokens.flatten(0, 1)[None]
    for block in blocks:
        x = block(x, rope, mask)
        outputs.append(x[0].unflatten(0, (frames, length))[:, registers:])
    return outputs
