"""Parts of the network as modules for every runtime."""

import sys
from pathlib import Path

import torch
from torch import nn

sys.path.insert(0, str(Path(__file__).resolve().parents[2] / "train"))

from streetforward.blocks import Block, patch_positions  # noqa: E402
from streetforward.config import preset  # noqa: E402
from streetforward.graph import FixedRope  # noqa: E402

DIM, HEADS = 1024, 16


class BlockPart(nn.Module):
    """A block of `full`: 1024 wide, 16 heads, rotary positions; x [B, tokens, 1024], `tokens` in rows of 18."""

    def __init__(self, tokens, seed=1):
        super().__init__()
        torch.manual_seed(seed)
        self.block = Block(DIM, HEADS, eps=1e-6)
        positions = patch_positions(tokens // 18 + 1, 18)[:tokens]
        self.rope = FixedRope(positions, DIM // HEADS, preset("full"))

    def forward(self, x):
        return self.block(x, self.rope)
