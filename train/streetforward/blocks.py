"""The transformer block that every part shares, and its 2-D rotary positions."""

import torch
import torch.nn.functional as F
from torch import nn


class Rope:
    """Rotary tables of one token sequence.

    The head width d is cut into two halves: the first turns with the row, the second with the column. Inside a half
    of size D, channel m pairs with channel m + D/2 and turns by theta_m = position * base^(-2m/D). Tokens at position
    (0, 0) do not turn.
    """

    def __init__(self, positions, head_dim, config):
        """positions [N, 2] (row, column) as integers."""
        half = head_dim // 2
        m = torch.arange(half // 2, dtype=torch.float64, device=positions.device)
        frequency = config["rope.base"] ** (-2.0 * m / half)
        theta = positions.to(torch.float64)[:, :, None] * frequency  # [N, 2, D/2]
        if config["rope.angle_round"] == "bf16":
            theta = theta.to(torch.float32).to(torch.bfloat16).to(torch.float64)
        self.cos, self.sin = theta.cos(), theta.sin()

    def __call__(self, x):
        """x [..., N, d] turned; same shape."""
        cos, sin = self.cos.to(x.dtype), self.sin.to(x.dtype)
        first, second = x.unflatten(-1, (2, 2, -1)).unbind(-2)  # each [..., N, 2, D/2]
        turned = torch.stack((first * cos - second * sin, second * cos + first * sin), dim=-2)
        return turned.flatten(-3)


def patch_positions(rows, columns, registers=0):
    """Positions [registers + P, 2]: registers at (0, 0), patches row-major at (row + 1, column + 1)."""
    row, column = torch.meshgrid(torch.arange(rows), torch.arange(columns), indexing="ij")
    patches = torch.stack((row, column), dim=-1).reshape(-1, 2) + 1
    return torch.cat((torch.zeros(registers, 2, dtype=patches.dtype), patches))


class Attention(nn.Module):
    """Multi-head attention; per-head layer norm of q and k when `qk_eps` is given."""

    def __init__(self, dim, heads, qk_eps=None):
        super().__init__()
        self.heads = heads
        self.keep = False  # training's matching loss reads the first head's queries and keys
        self.qkv = nn.Linear(dim, 3 * dim)
        if qk_eps is not None:
            self.q_norm = nn.LayerNorm(dim // heads, eps=qk_eps)
            self.k_norm = nn.LayerNorm(dim // heads, eps=qk_eps)
        self.proj = nn.Linear(dim, dim)

    def forward(self, x, rope=None, mask=None):
        """x [B, N, C]; mask [N, N] true where the row's query sees the column's key.

        A query that sees no key gets attention output 0: the bias of `proj` still applies to it.
        """
        q, k, v = self.qkv(x).unflatten(-1, (3, self.heads, -1)).permute(2, 0, 3, 1, 4)  # each [B, heads, N, d]
        if hasattr(self, "q_norm"):
            q, k = self.q_norm(q), self.k_norm(k)
        if rope is not None:
            q, k = rope(q), rope(k)
        if self.keep:
            self.kept = q[:, 0], k[:, 0]
        y = F.scaled_dot_product_attention(q, k, v, attn_mask=mask)
        if mask is not None:
            y = torch.where(mask.any(dim=-1)[:, None], y, torch.zeros_like(y))
        return self.proj(y.transpose(1, 2).flatten(2))


class Mlp(nn.Module):
    """Two linear layers around the exact (erf) GELU."""

    def __init__(self, dim, ratio):
        super().__init__()
        self.fc1 = nn.Linear(dim, ratio * dim)
        self.fc2 = nn.Linear(ratio * dim, dim)

    def forward(self, x):
        return self.fc2(F.gelu(self.fc1(x)))


class LayerScale(nn.Module):
    """A learned factor per channel."""

    def __init__(self, dim, start):
        super().__init__()
        self.gamma = nn.Parameter(torch.full((dim,), start))

    def forward(self, x):
        return x * self.gamma


class Block(nn.Module):
    """Pre-norm block: x += ls1(attn(norm1 x)); x += ls2(mlp(norm2 x)).

    `scale` is the start value of the layer scales, None for blocks without them (the heads' decoders).
    """

    def __init__(self, dim, heads, *, eps, ratio=4, qk_eps=None, scale=None):
        super().__init__()
        self.norm1 = nn.LayerNorm(dim, eps=eps)
        self.attn = Attention(dim, heads, qk_eps)
        self.ls1 = nn.Identity() if scale is None else LayerScale(dim, scale)
        self.norm2 = nn.LayerNorm(dim, eps=eps)
        self.mlp = Mlp(dim, ratio)
        self.ls2 = nn.Identity() if scale is None else LayerScale(dim, scale)

    def forward(self, x, rope=None, mask=None):
        x = x + self.ls1(self.attn(self.norm1(x), rope, mask))
        return x + self.ls2(self.mlp(self.norm2(x)))
