"""Scenes of one clip that can be differentiated: outputs to Gaussians at a time, and images of them.

The rules are the engine's (`formats/src/scene.rs`): all static Gaussians, and the dynamic ones of the frames beside the
time, moved to it. `own = False` is the paper's training rule: at an input frame its own dynamic Gaussians are left out, so
that the neighbours' must explain it.
"""

from dataclasses import dataclass

import torch

from . import gaussians as g

FIELDS = ("mean", "scale", "quat", "opacity", "colour")


@dataclass
class Scene:
    """One clip; per-pixel tensors are [F, H, W, ...], world axes."""

    mean: torch.Tensor
    scale: torch.Tensor
    quat: torch.Tensor
    opacity: torch.Tensor
    colour: torch.Tensor
    v_fwd: torch.Tensor
    v_bwd: torch.Tensor
    dynamic: torch.Tensor
    sky: torch.Tensor  # bool
    depth: torch.Tensor
    times: torch.Tensor  # f64 [F]
    pose: torch.Tensor  # f64 [F, 4, 4], camera to world
    k: torch.Tensor  # f64 [F, 4]


def scene_of(raw, b, frames, image, times, config):
    """The scene of clip b of a batch whose heads ran on all frames.

    raw: `batched.Raw` with depth, gs and motion of every frame, rows in order; image [F, H, W, 3] in 0..1.
    """
    rows = slice(b * frames, (b + 1) * frames)
    log_z = raw.log_depth(config)[rows]
    fov = None if raw.fov is None else raw.fov[b]
    points = log_z.exp()[..., None]
    if config["depth.out_map"] == "pi3_point":
        points = torch.cat((raw.depth[rows][..., :2] * points, points), dim=-1)
    k = g.intrinsics(points, fov, config)
    pose = g.anchored_poses(g.raw_poses(raw.rotation[b], raw.translation[b]), config)
    depth = points[..., -1]
    channels = raw.gs[rows] if raw.gs is not None else image.new_zeros(*image.shape[:3], 11)
    colour, opacity, scale, quat = g.gaussian_maps(channels, image, depth, k, pose, config)
    depth = depth * config["world.scale"]
    mean = g.unproject(depth, k, pose, config)
    if raw.motion:
        v_fwd, v_bwd, dynamic = g.motion_maps({w: m[rows] for w, m in raw.motion.items()}, times, pose, config)
    else:
        v_fwd = v_bwd = torch.zeros_like(mean)
        dynamic = torch.zeros_like(depth)
    sky = torch.zeros_like(depth, dtype=torch.bool)
    solid = raw.solid(config)
    if config["sky.mode"] == "far_shell" and solid is not None:
        sky = solid[rows].sigmoid() < config["sky.conf"]
        mean, scale, still = far_shell(mean, scale, depth, sky, pose)
        dynamic = torch.where(still, torch.zeros_like(dynamic), dynamic)
        v_fwd, v_bwd = (torch.where(still[..., None], torch.zeros_like(v), v) for v in (v_fwd, v_bwd))
    return Scene(mean, scale, quat, opacity, colour, v_fwd, v_bwd, dynamic, sky, depth, times, pose, k)


def far_shell(mean, scale, depth, sky, pose):
    """Sky pixels nearer than twice the largest other depth go out to it along their rays; which ones, comes third."""
    land = torch.where(sky, torch.zeros_like(depth), depth).detach().amax()
    grow = 2 * land / depth.detach()
    out = sky & (grow > 1)
    grow = torch.where(out, grow, torch.ones_like(grow))[..., None]
    eye = pose[:, None, None, :3, 3].to(mean)
    return eye + (mean - eye) * grow, scale * grow, out


def sources(times, time, own):
    """(frame, seconds on v_fwd, seconds on v_bwd) of the frames whose dynamic Gaussians exist at `time`."""
    times = times.tolist()
    n, last = len(times), len(times) - 1
    here = next((f for f, t in enumerate(times) if abs(t - time) <= 1e-6), None)
    before = sum(t < time - 1e-6 for t in times)
    if here is None:
        frames = range(max(before - 1, 0), min(before + 1, n))
    elif own or n == 1:
        frames = [here]
    else:
        frames = [f for f in (here - 1, here + 1) if 0 <= f < n]
    result = []
    for f in frames:
        after = time - times[f]
        if f == here:
            result.append((f, 0.0, 0.0))
        elif after > 0:  # beyond the last frame only its backward velocity is trained, mirrored
            result.append((f, 0.0, -after) if f == last and n > 1 else (f, after, 0.0))
        else:
            result.append((f, after, 0.0) if f == 0 and n > 1 else (f, 0.0, -after))
    return result


def gaussians_at(scene, time, config, own=True, without=None, stage_one=False):
    """Fields [N, ...] of the Gaussians that exist at `time`.

    `without` leaves out a frame's static Gaussians too, `stage_one` is the paper's schedule before motion: no dynamic
    Gaussian travels, those of the frame at `time` stand where they are.

    `render.split` "hard" makes each Gaussian static or dynamic; "soft" makes it both, its opacity shared by probability, which
    then learns from the image.
    """
    if config["render.split"] == "soft":
        moving, still = scene.dynamic > 0, scene.dynamic < 1
        share = scene.dynamic, 1 - scene.dynamic
    else:
        moving = scene.dynamic > config["motion.tau"]
        still = ~moving
        share = torch.ones_like(scene.dynamic), torch.ones_like(scene.dynamic)
    if without is not None:
        still = still.clone()
        still[without] = False
    parts = [{name: getattr(scene, name)[still] for name in FIELDS}]
    parts[0]["opacity"] = parts[0]["opacity"] * share[1][still]
    for frame, ahead, behind in sources(scene.times, time, own or stage_one):
        if frame == without or (stage_one and (ahead or behind)):
            continue
        chosen = moving[frame]
        part = {name: getattr(scene, name)[frame][chosen] for name in FIELDS}
        part["opacity"] = part["opacity"] * share[0][frame][chosen]
        shift = ahead * scene.v_fwd[frame][chosen] + behind * scene.v_bwd[frame][chosen]
        parts.append(part | {"mean": part["mean"] + shift})
    return {name: torch.cat([part[name] for part in parts]) for name in FIELDS}


def pose_between(a, b, s):
    """Camera-to-world [4, 4] between two: the rotation by the arc, the centre by the line."""
    turn = a[:3, :3].mT @ b[:3, :3]
    w = torch.stack((turn[2, 1] - turn[1, 2], turn[0, 2] - turn[2, 0], turn[1, 0] - turn[0, 1])) / 2
    sine, cosine = w.norm(), (turn.diagonal().sum() - 1) / 2
    factor = torch.where(sine > 1e-9, torch.atan2(sine, cosine) / sine.clamp_min(1e-12), torch.ones_like(sine))
    x, y, z = (s * factor * w).unbind()
    o = torch.zeros_like(x)
    cross = torch.stack((o, -z, y, z, o, -x, -y, x, o)).view(3, 3)
    pose = torch.eye(4, dtype=a.dtype, device=a.device)
    pose[:3, :3] = a[:3, :3] @ torch.linalg.matrix_exp(cross)
    pose[:3, 3] = (1 - s) * a[:3, 3] + s * b[:3, 3]
    return pose


def camera_at(scene, time):
    """Pose and K at a time: between input frames, carried on beyond the ends."""
    times = scene.times.tolist()
    hi = max(next((i for i, t in enumerate(times) if t >= time), len(times) - 1), 1)
    s = (time - times[hi - 1]) / (times[hi] - times[hi - 1])
    near = hi - 1 if s < 0.5 else hi
    return pose_between(scene.pose[hi - 1], scene.pose[hi], s), scene.k[near]


def draw(fields, pose, k, size, config, background=(0.0, 0.0, 0.0)):
    """rgb [H, W, 3], composited depth [H, W], coverage [H, W]; size (W, H)."""
    from .raster import rasterize

    fx, fy, cx, cy = k.detach().tolist()
    return rasterize(
        fields["mean"], fields["quat"], fields["scale"], fields["opacity"], fields["colour"],
        torch.linalg.inv(pose), fx, fy, cx, cy, *size,
        antialiased=config["splat.aa"], a_max=config["splat.a_max"], eps2d=config["splat.eps2d"],
        near=config["splat.near"], background=background,
    )
