"""The image encoder: DINOv2 with register tokens."""

import torch
from torch import nn

from .blocks import Block


def cubic(x):
    """Keys' cubic kernel with a = -0.5 on |x|."""
    near = (1.5 * x - 2.5) * x * x + 1
    far = -0.5 * (((x - 5) * x + 8) * x - 4)
    return torch.where(x < 1, near, torch.where(x < 2, far, torch.zeros_like(x)))


def resize_matrix(n, m):
    """Weights [m, n] of the antialiased bicubic resize of n samples to m, in f64.

    The window is widened by s = n / m when shrinking, cut at the edges and divided by its sum (Pillow's rule):
    edge samples are never repeated.
    """
    s = n / m
    support, gain = (2 * s, 1 / s) if s >= 1 else (2.0, 1.0)
    weights = torch.zeros(m, n, dtype=torch.float64)
    for i in range(m):
        centre = s * (i + 0.5)
        lo = max(int(centre - support + 0.5), 0)
        hi = min(int(centre + support + 0.5), n)
        j = torch.arange(lo, hi, dtype=torch.float64)
        w = cubic(((j - centre + 0.5) * gain).abs())
        weights[i, lo:hi] = w / w.sum()
    return weights


def resize_positions(table, rows, columns):
    """Position table [1 + G*G, C] for a rows x columns grid: [1 + rows*columns, C]; entry 0 belongs to cls."""
    grid = round((table.shape[0] - 1) ** 0.5)
    if rows == columns == grid:
        return table
    square = table[1:].to(torch.float64).unflatten(0, (grid, grid))
    down, across = (resize_matrix(grid, m).to(table.device) for m in (rows, columns))
    resized = torch.einsum("yi,xj,ijc->yxc", down, across, square)
    return torch.cat((table[:1], resized.flatten(0, 1).to(table.dtype)))


class PatchEmbed(nn.Module):
    """One linear map per patch, written as a strided convolution."""

    def __init__(self, dim, patch):
        super().__init__()
        self.proj = nn.Conv2d(3, dim, patch, stride=patch)

    def forward(self, x):
        """x [F, 3, H, W] to [F, P, C], patches row-major."""
        return self.proj(x).flatten(2).transpose(1, 2)


class Encoder(nn.Module):
    """Images to one token per patch. Token order: cls, registers, patches."""

    def __init__(self, config):
        super().__init__()
        dim, registers = config["encoder.dim"], config["encoder.registers"]
        self.cls_token = nn.Parameter(torch.zeros(1, 1, dim))
        self.pos_embed = nn.Parameter(torch.zeros(1, 1 + config["encoder.pos_grid"] ** 2, dim))
        self.register_tokens = nn.Parameter(torch.zeros(1, registers, dim)) if registers else None
        self.patch_embed = PatchEmbed(dim, config["patch"])
        self.blocks = nn.ModuleList(
            Block(
                dim,
                config["encoder.heads"],
                eps=config["encoder.eps"],
                ratio=config["encoder.mlp_ratio"],
                scale=1.0,
            )
            for _ in range(config["encoder.depth"])
        )
        self.norm = nn.LayerNorm(dim, eps=config["encoder.eps"])

    def forward(self, x, note):
        """x [F, 3, H, W] normalised; patch tokens [F, P, C]."""
        frames, _, height, width = x.shape
        patch = self.patch_embed.proj.stride[0]
        patches = note("patches", self.patch_embed(x))
        positions = note("pos", resize_positions(self.pos_embed[0], height // patch, width // patch))
        x = torch.cat((self.cls_token.expand(frames, -1, -1), patches), dim=1) + positions
        special = 1
        if self.register_tokens is not None:  # inserted after the positions: registers have none
            registers = self.register_tokens.expand(frames, -1, -1)
            x = torch.cat((x[:, :1], registers, x[:, 1:]), dim=1)
            special += registers.shape[1]
        for block in self.blocks:
            x = block(x)
        return note("encoder", self.norm(x)[:, special:])
