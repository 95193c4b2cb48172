"""Alternating attention: layers inside a frame and layers over all frames, in turn."""

import torch
from torch import nn

from .blocks import Block, Rope, patch_positions


def aa_blocks(config):
    """The stack, named `decoder` as in Pi3's files."""
    return nn.ModuleList(
        Block(
            config["aa.dim"],
            config["aa.heads"],
            eps=config["aa.eps"],
            ratio=config["aa.mlp_ratio"],
            qk_eps=config["aa.qk_eps"],
            scale=0.01,
        )
        for _ in range(config["aa.depth"])
    )


def aggregate(blocks, tokens, grid, config, note):
    """tokens [F, T, C], registers first; returns the output of every layer, each [F, T, C].

    Even layers attend inside a frame and odd ones over all frames (`aa.order` frame_first), or the other way round.
    Positions are spatial only: no frame index enters here.
    """
    frames, length, _ = tokens.shape
    positions = patch_positions(*grid, config["aa.registers"]).to(tokens.device)
    head_dim = config["aa.dim"] // config["aa.heads"]
    inside = Rope(positions, head_dim, config)
    across = Rope(positions.repeat(frames, 1), head_dim, config)
    global_parity = 1 if config["aa.order"] == "frame_first" else 0

    outputs, x = [], tokens
    for i, block in enumerate(blocks):
        if i % 2 == global_parity:
            x = block(x.flatten(0, 1)[None], across).unflatten(1, (frames, length))[0]
        else:
            x = block(x, inside)
        outputs.append(note(f"aa.{i}", x))
    return outputs


def last_features(outputs, concat):
    """What a consumer reads: the last pair's layers side by side (`frame_global`) or the last layer (`last`)."""
    return torch.cat(outputs[-2:], dim=-1) if concat == "frame_global" else outputs[-1]
