"""Losses on labels: depth, sky, cameras, motion, and attention that should look at the same surface in another frame."""

import torch
import torch.nn.functional as F

from .data import FAR

DYNAMIC = 1.0  # m/s: faster pixels count as moving, as in the generator's masks
NEAR = 80.0  # metres: depth beyond is asked for more softly


def log_depth_loss(log_z, depth):
    """L1 of ln z and of its differences over 1 and 4 pixels; log_z, depth [N, H, W], depth 0 is sky.

    Sky is drawn to the far end with weight 0.1 and has no part in the differences.
    """
    sky = depth <= 0
    target = torch.where(sky, torch.full_like(depth, FAR), depth).clamp(0.1, FAR).log()
    error = log_z - target
    weight = torch.where(sky, 0.1, torch.where(depth > NEAR, 0.3, 1.0))
    value = (error.abs() * weight).sum() / weight.sum()
    solid = (~sky).float()
    slope = 0.0
    for step in (1, 4):
        for dim in (1, 2):
            n = error.shape[dim] - step
            both = solid.narrow(dim, step, n) * solid.narrow(dim, 0, n)
            change = error.narrow(dim, step, n) - error.narrow(dim, 0, n)
            slope = slope + (change.abs() * both).sum() / both.sum().clamp_min(1) / 4
    return value, slope


def sky_loss(logit, depth):
    """`logit` > 0 says that a pixel is not sky."""
    return F.binary_cross_entropy_with_logits(logit, (depth > 0).float())


def relative(pose_rotation, pose_translation):
    """Camera j in the axes of camera i, for all i and j: rotations [B, F, F, 3, 3], translations [B, F, F, 3]."""
    r, t = pose_rotation, pose_translation
    turn = r[:, :, None].mT @ r[:, None]
    shift = (r[:, :, None].mT @ (t[:, None] - t[:, :, None])[..., None])[..., 0]
    return turn, shift


def camera_losses(rotation, translation, pose):
    """All ordered pairs of frames: summed |R - R'| per pair, smooth L1 of translations. No frame is special."""
    turn, shift = relative(rotation, translation.to(rotation))
    true_turn, true_shift = relative(pose[..., :3, :3].to(rotation), pose[..., :3, 3].to(rotation))
    rotation_loss = (turn - true_turn).abs().sum((-2, -1)).mean()
    translation_loss = F.smooth_l1_loss(shift, true_shift, beta=0.3)
    return rotation_loss.float(), translation_loss.float()


def focal_loss(fov, focal, size):
    """fov [B, F, 2] against ln(focal / side); focal [B, 2], size (W, H)."""
    sides = torch.tensor(size, dtype=focal.dtype, device=focal.device)
    return (fov - (focal / sides).log()[:, None].to(fov)).abs().mean()


def motion_losses(raw, velocity, depth, config):
    """raw [N, H, W, 4] of one pass that should give `velocity` [N, H, W, 3] m/s in camera axes: (velocity, dynamic).

    Moving pixels are divided by their own count (at least 200), or the still ones would drown them.
    """
    predicted = raw[..., :3] * config["motion.scale"]
    moving = (velocity.norm(dim=-1) > DYNAMIC).float()
    error = F.smooth_l1_loss(predicted, velocity, beta=1.0, reduction="none").sum(-1)
    still = (1 - moving) * (depth > 0)
    value = (error * moving).sum() / moving.sum().clamp_min(200) + 0.35 * (error * still).sum() / still.sum().clamp_min(1)
    logit = raw[..., 3] + config["motion.bias"]
    weight = 1 + moving
    mask = F.binary_cross_entropy_with_logits(logit, moving, weight, reduction="sum") / weight.sum()
    return value, mask


def patch_matches(batch, patch):
    """Where the surface at each patch's centre is in the other frames.

    Returns positions [B, F, P, F, 2] in patch units (row, column; 0 is the first patch's centre), valid [B, F, P, F]
    (seen in both frames: inside, no sky, depth within a tenth) and moving [B, F, P].
    """
    depth, velocity = batch.depth, batch.velocity
    frames, height, width = depth.shape[1:]
    rows = torch.arange(patch // 2, height, patch, device=depth.device)
    columns = torch.arange(patch // 2, width, patch, device=depth.device)
    z = depth[:, :, rows[:, None], columns].flatten(2)  # [B, F, P]
    v = velocity[:, :, rows[:, None], columns].flatten(2, 3)
    focal = batch.focal.float()[:, None, None]
    u = torch.stack(torch.meshgrid(columns + 0.5, rows + 0.5, indexing="xy"), dim=-1).flatten(0, 1)  # [P, 2] (x, y)
    centre = torch.tensor([width / 2, height / 2], device=depth.device)
    here = torch.cat(((u - centre) / focal * z[..., None], z[..., None]), dim=-1)  # [B, F, P, 3]
    times, pose = batch.times.float(), batch.pose.float()
    after = times[:, None, :] - times[:, :, None]  # [B, i, j]
    moved = here[:, :, :, None] + v[:, :, :, None] * after[:, :, None, :, None]  # [B, i, P, j, 3]
    turn, shift = relative(pose[..., :3, :3], pose[..., :3, 3])  # camera j in camera i
    there = torch.einsum("bijxy,bipjx->bipjy", turn, moved - shift[:, :, None])  # inverse: R^T (x - t)
    seen_z = there[..., 2]
    pixel = there[..., :2] / seen_z.clamp_min(0.1)[..., None] * focal[..., None, :] + centre
    x, y = pixel[..., 0].floor().long(), pixel[..., 1].floor().long()
    inside = (seen_z > 0.5) & (x >= 0) & (x < width) & (y >= 0) & (y < height)
    b = torch.arange(len(depth), device=depth.device)[:, None, None, None]
    j = torch.arange(frames, device=depth.device)
    found = depth[b, j, y.clamp(0, height - 1), x.clamp(0, width - 1)]
    valid = inside & (z > 0)[..., None] & ((found - seen_z).abs() < 0.1 * seen_z)
    position = torch.stack((pixel[..., 1], pixel[..., 0]), dim=-1) / patch - 0.5
    return position, valid, v.norm(dim=-1) > DYNAMIC


def matching_loss(kept, matches, grid):
    """Cross entropy of attention, renormalised over each target frame, against the four patches around the match.

    kept: (name, queries, keys) [B, F, P, d]. Global layers answer for all other frames, a causal pass for its
    neighbour. Patches on moving surfaces count five times.
    """
    position, valid, moving = matches
    frames = position.shape[1]
    rows, columns = grid
    high = torch.tensor([rows - 1, columns - 1], device=position.device)
    position = torch.minimum(position.clamp_min(0), high.to(position))
    low = torch.minimum(position.floor(), (high - 1).to(position))
    part = position - low  # [B, F, P, F, 2]
    low = low.long()
    index, weight = [], []
    for dy in (0, 1):
        for dx in (0, 1):
            index.append((low[..., 0] + dy) * columns + low[..., 1] + dx)
            wy, wx = (part[..., c] if d else 1 - part[..., c] for c, d in ((0, dy), (1, dx)))
            weight.append(wy * wx)
    index, weight = torch.stack(index, -1), torch.stack(weight, -1)  # [B, F, P, F, 4]
    importance = valid * (1 + 4 * moving.float())[..., None]
    step = torch.arange(frames, device=position.device)
    step = step[None, :] - step[:, None]  # [i, j]
    result = {}
    for name, q, k in kept:
        wanted = step != 0
        if ".fwd." in name or ".bwd." in name:
            wanted = step == (1 if ".fwd." in name else -1)
        i, j = wanted.nonzero(as_tuple=True)
        score = q[:, i].float() @ k[:, j].float().mT * q.shape[-1] ** -0.5  # [B, pairs, P, P]
        log_p = score.log_softmax(-1).gather(-1, index[:, i, :, j].permute(1, 0, 2, 3))
        w = importance[:, i, :, j].permute(1, 0, 2)
        loss = -(log_p * weight[:, i, :, j].permute(1, 0, 2, 3)).sum(-1)
        result[name] = (loss * w).sum() / w.sum().clamp_min(1)
    return result
