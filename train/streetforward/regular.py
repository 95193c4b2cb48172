"""Losses of the paper: on drawn images, on opacity and depth, and on motion without labels.

Sums over frames and pixels are means here, so that weights do not depend on the picture's size.
"""

import torch


def attenuate(x, share):
    """x, of whose gradient `share` passes: the paper damps what L_rgb does to opacity early in training."""
    return share * x + (1 - share) * x.detach()


def rgb_loss(drawn, truth):
    """L_rgb: L1 of drawn [H, W, 3] and true colours."""
    return (drawn - truth).abs().mean()


def opacity_loss(opacity, weight=None):
    """L_alpha: w |1 - alpha|^2 over Gaussians."""
    error = (1 - opacity).square()
    return error.mean() if weight is None else (error * weight).sum() / weight.sum().clamp_min(1e-6)


def depth_loss(depth, drawn, mask):
    """L_depth: L1 of a frame's depth and the composited depth sum T alpha z, not divided by coverage, where `mask`.

    Sky is left out: its far shell would outweigh everything else.
    """
    return ((depth - drawn).abs() * mask).sum() / mask.sum().clamp_min(1)


def rigid_2d_loss(velocity, dynamic):
    """L_rigid-2D: |v - v'|^2 over pairs of pixels in a 3x3 window, weighted by the product of dynamic probabilities.

    velocity [F, H, W, 3], dynamic [F, H, W]. Each unordered pair counts once.
    """
    height, width = dynamic.shape[1:]
    total, weights = 0.0, 0.0
    for dy, dx in ((0, 1), (1, -1), (1, 0), (1, 1)):
        here = (slice(None), slice(0, height - dy), slice(max(-dx, 0), width - max(dx, 0)))
        there = (slice(None), slice(dy, height), slice(max(dx, 0), width - max(-dx, 0)))
        weight = dynamic[here] * dynamic[there]
        total = total + (weight * (velocity[here] - velocity[there]).square().sum(-1)).sum()
        weights = weights + weight.sum()
    return total / weights.clamp_min(1)


def rigid_3d_loss(mean, velocity, dynamic, neighbours=8, points=1024, generator=None):
    """L_rigid-3D: the same over the nearest neighbours in space of each frame, on a random choice of points.

    mean, velocity [F, H, W, 3], dynamic [F, H, W].
    """
    total, weights = 0.0, 0.0
    for m, v, p in zip(mean.flatten(1, 2), velocity.flatten(1, 2), dynamic.flatten(1)):
        if len(p) > points:
            chosen = torch.randperm(len(p), generator=generator)[:points].to(p.device)
            m, v, p = m[chosen], v[chosen], p[chosen]
        k = min(neighbours, len(p) - 1)
        near = torch.cdist(m.detach(), m.detach()).fill_diagonal_(torch.inf).topk(k, largest=False).indices
        weight = p[:, None] * p[near]
        total = total + (weight * (v[:, None] - v[near]).square().sum(-1)).sum()
        weights = weights + weight.sum()
    return total / weights.clamp_min(1)


def symmetry_loss(v_fwd, v_bwd):
    """L_fb: |v+ + v-|_1 per pixel, v- pointing where the surface came from; ends, whose other direction mirrors, give 0."""
    return (v_fwd + v_bwd).abs().sum(-1).mean()


def psnr(a, b, mask=None):
    """Decibels of images in 0..1, over a mask [H, W] if given."""
    error = (a.clamp(0, 1) - b).square().mean(-1)
    mse = error.mean() if mask is None else (error * mask).sum() / mask.sum()
    return -10 * torch.log10(mse.clamp_min(1e-10))
