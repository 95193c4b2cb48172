"""Linear read-outs, of training only, that ask tokens where their surface is in the other frames.

Attention that finds the match (`losses.matching_loss`) is of no use to pose and velocity before the token also says how far the
match is away. A linear layer on the normalised token predicts that displacement, so the residual stream has to hold it;
the layer itself is not part of the network and is not shipped.
"""

import torch
import torch.nn.functional as F
from torch import nn

from . import config as cfg

NAME = "probe"  # its module on a model in training; `weights.write_model` leaves it out


class Probe(nn.Module):
    """`layers` as in `forward_clips(tokens_of=)`; global layers answer for every frame, causal ones for the neighbour."""

    def __init__(self, layers, frames, config):
        super().__init__()
        self.linear = nn.ModuleDict()
        for name in layers:
            causal = name.startswith("causal.")
            width = cfg.causal_dim(config) if causal else config["aa.dim"]
            linear = nn.Linear(width, 2 if causal else 2 * frames)
            nn.init.zeros_(linear.weight)
            nn.init.zeros_(linear.bias)
            self.linear[name.replace(".", "_")] = linear

    def forward(self, name, tokens):
        """Tokens [B, F, P, C] of layer `name` ("decoder.5", "causal.fwd.1"); displacements in patches [B, F, P, frames or 1, 2]."""
        part = name.split(".")
        linear = self.linear[f"{part[0]}_{part[-1]}"]
        return linear(F.layer_norm(tokens, tokens.shape[-1:])).unflatten(-1, (-1, 2))


def displacement_loss(probe, tokens, matches):
    """Smooth L1 (half a patch) between predicted and true displacements of patch centres, by layer.

    tokens: {name: [B, F, P, C]}; matches as of `losses.patch_matches`. Only what both frames see counts, moving surfaces
    five times.
    """
    position, valid, moving = matches
    frames = position.shape[1]
    step = torch.arange(frames, device=position.device)
    step = step[None, :] - step[:, None]  # [i, j]
    own = position.diagonal(dim1=1, dim2=3).permute(0, 3, 1, 2)  # [B, F, P, 2]: where a frame sees its own centres
    truth = position - own[:, :, :, None]
    importance = valid * (1 + 4 * moving.float())[..., None]
    result = {}
    for name, x in tokens.items():
        wanted = step != 0
        if ".fwd." in name or ".bwd." in name:
            wanted = step == (1 if ".fwd." in name else -1)
        predicted = probe(name, x).expand(-1, -1, -1, frames, -1)
        error = F.smooth_l1_loss(predicted, truth.to(predicted), beta=0.5, reduction="none").sum(-1)
        weight = importance * wanted[:, None]
        result[name] = (error * weight).sum() / weight.sum().clamp_min(1)
    return result
