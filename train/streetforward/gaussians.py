"""From raw head outputs to cameras, Gaussians and motion in world axes."""

import torch
import torch.nn.functional as F

from .causal import frame_mask, pass_ranges


def fit_focal(points, shared):
    """Focal lengths [F, 2] in f64 from local points [F, H, W, 3], principal point at the image centre.

    Least squares of u + 0.5 - W/2 = fx X on the rays X = x / z (likewise fy), over all pixels of all frames
    (`shared`) or of each frame.
    """
    frames, height, width, _ = points.shape
    points = points.to(torch.float64)
    rays = points[..., :2] / points[..., 2:]
    u = torch.arange(width, dtype=torch.float64, device=points.device) + 0.5 - width / 2
    v = torch.arange(height, dtype=torch.float64, device=points.device) + 0.5 - height / 2
    offsets = torch.stack((u.expand(height, -1), v[:, None].expand(-1, width)), dim=-1)
    dims = (0, 1, 2) if shared else (1, 2)
    focal = (rays * offsets).sum(dims) / (rays * rays).sum(dims)
    return focal.expand(frames, 2)


def intrinsics(points, fov, config):
    """K as (fx, fy, cx, cy) [F, 4] in f64, half-pixel convention; points [F, H, W, 3 or 1], fov [F, 2] or None."""
    frames, height, width, _ = points.shape
    size = torch.tensor([width, height], dtype=torch.float64, device=points.device)
    if config["camera.k"] == "fov":
        focal = size * fov.to(torch.float64).exp()
    else:
        focal = fit_focal(points, shared=config["camera.k"] == "fit_shared")
    return torch.cat((focal, (size / 2).expand(frames, 2)), dim=-1)


def raw_poses(rotation, translation):
    """Camera-to-world matrices [F, 4, 4] in f64, in the network's own gauge."""
    pose = torch.eye(4, dtype=torch.float64, device=rotation.device).repeat(len(rotation), 1, 1)
    pose[:, :3, :3] = rotation
    pose[:, :3, 3] = translation.to(torch.float64)
    return pose


def anchored_poses(pose, config):
    """World = first camera (`world.anchor` first) or the network's gauge; translations in scene units."""
    if config["world.anchor"] == "first":
        pose = torch.linalg.inv(pose[:1]) @ pose
    pose = pose.clone()
    pose[:, :3, 3] *= config["world.scale"]
    return pose


def unproject(depth, k, pose, config):
    """World points [F, H, W, 3] of depths [F, H, W] (z, not ray length) in scene units."""
    _, height, width = depth.shape
    centre = 0.5 if config["camera.pixel"] == "half" else 0.0
    u = torch.arange(width, dtype=depth.dtype, device=depth.device) + centre
    v = torch.arange(height, dtype=depth.dtype, device=depth.device) + centre
    fx, fy, cx, cy = (k[:, i, None, None].to(depth.dtype) for i in range(4))
    x = ((u - cx) / fx).expand_as(depth)
    y = ((v[:, None] - cy) / fy).expand_as(depth)
    local = torch.stack((x, y, torch.ones_like(x)), dim=-1) * depth[..., None]
    return rotate(pose, local) + pose[:, None, None, :3, 3].to(depth.dtype)


def rotate(pose, vectors):
    """Vectors [F, H, W, 3] from camera to world axes."""
    return torch.einsum("fij,fhwj->fhwi", pose[:, :3, :3].to(vectors.dtype), vectors)


def quaternion(rotation):
    """Unit quaternions (w, x, y, z) [F, 4] of rotations [F, 3, 3].

    |w| .. |z| come from the diagonal; the largest of them fixes the signs of the others without cancellation.
    """
    m = rotation
    xx, yy, zz = m[:, 0, 0], m[:, 1, 1], m[:, 2, 2]
    wx, wy, wz = m[:, 2, 1] - m[:, 1, 2], m[:, 0, 2] - m[:, 2, 0], m[:, 1, 0] - m[:, 0, 1]
    xy, xz, yz = m[:, 1, 0] + m[:, 0, 1], m[:, 0, 2] + m[:, 2, 0], m[:, 2, 1] + m[:, 1, 2]
    # Row i is 4 q_i q: the row of the largest q_i is the best conditioned multiple of q.
    rows = torch.stack(
        [
            torch.stack((1 + xx + yy + zz, wx, wy, wz), dim=-1),
            torch.stack((wx, 1 + xx - yy - zz, xy, xz), dim=-1),
            torch.stack((wy, xy, 1 - xx + yy - zz, yz), dim=-1),
            torch.stack((wz, xz, yz, 1 - xx - yy + zz), dim=-1),
        ],
        dim=1,
    )
    best = rows.diagonal(dim1=1, dim2=2).argmax(dim=-1)
    return F.normalize(rows[torch.arange(len(rows)), best], dim=-1)


def hamilton(a, b):
    """Quaternion product a * b: the rotation b, then a."""
    aw, ax, ay, az = a.unbind(-1)
    bw, bx, by, bz = b.unbind(-1)
    return torch.stack(
        (
            aw * bw - ax * bx - ay * by - az * bz,
            aw * bx + ax * bw + ay * bz - az * by,
            aw * by - ax * bz + ay * bw + az * bx,
            aw * bz + ax * by - ay * bx + az * bw,
        ),
        dim=-1,
    )


def gaussian_maps(raw, image, depth, k, pose, config):
    """Appearance of one Gaussian per pixel from raw channels: colour 3, opacity 1, scale 3, quaternion 4 (wxyz).

    raw [F, H, W, 11], image [F, H, W, 3] in 0..1, depth [F, H, W] in network units. Returns colour, opacity, scale in
    scene units and the quaternion in world axes.
    """
    colour, opacity, scale, turn = raw.split((3, 1, 3, 4), dim=-1)
    opacity = opacity[..., 0]
    if config["gs.out_map"] == "dggt":
        colour, opacity, scale = colour.sigmoid(), opacity.sigmoid(), 0.1 * F.softplus(scale)
        turn = F.normalize(turn, dim=-1)
    else:
        focal = k[:, :2].mean(dim=-1).to(raw.dtype)
        pixel = depth / focal[:, None, None]
        identity = torch.tensor([1, 0, 0, 0], dtype=raw.dtype, device=raw.device)
        colour, opacity = image + colour, (opacity + 2).sigmoid()
        scale = 0.7 * pixel[..., None] * scale.clamp(-4, 4).exp()
        camera = quaternion(pose[:, :3, :3]).to(raw.dtype)[:, None, None]
        turn = hamilton(camera, F.normalize(turn + identity, dim=-1))
    turn = torch.where(turn[..., :1] < 0, -turn, turn)
    return colour, opacity, scale * config["world.scale"], turn


def has_neighbour(frames, reach):
    """[F] whether any frame but the own one lies in the mask's range."""
    return (frame_mask(frames, *reach) & ~torch.eye(frames, dtype=torch.bool)).any(dim=-1)


def steps(times):
    """Seconds to the next and to the previous frame, each [F]; at an end the step of the other side."""
    step = times.diff()
    return torch.cat((step, step[-1:])), torch.cat((step[:1], step))


def motion_maps(raw, times, pose, config):
    """Velocities and dynamic probability from the motion head's outputs.

    raw {"fwd", "bwd"}: [F, H, W, 4] each, or {"fwd": [F, H, W, 7]} for the single-pass layout. Returns v_fwd, v_bwd
    [F, H, W, 3] (world axes, scene units per second; v_bwd points where the surface came from) and dynamic [F, H, W].
    """
    frames = len(times)
    # A mask of no frames (an ablation) does not take away what there is to move towards.
    k = max(1, config["mask.k"])
    reach = pass_ranges(config | {"mask.k": k})
    if config["motion.layout"] == "single_pass":
        ahead, behind, logit = raw["fwd"].split((3, 3, 1), dim=-1)
        velocity = {"fwd": ahead, "bwd": behind}
        logits = {"fwd": logit[..., 0], "bwd": logit[..., 0]}
        reach = {"fwd": (1, k), "bwd": (-k, -1)}
    else:
        velocity = {way: r[..., :3] for way, r in raw.items()}
        logits = {way: r[..., 3] for way, r in raw.items()}

    sign = {"fwd": 1, "bwd": config["motion.back_sign"]}
    step = dict(zip(("fwd", "bwd"), steps(times)))
    for way in ("fwd", "bwd"):
        v = velocity[way] * (config["motion.scale"] * config["world.scale"] * sign[way])
        if config["motion.frame"] == "camera":
            v = rotate(pose, v)
        if config["motion.per"] == "step":
            v = v / step[way].to(v.dtype)[:, None, None, None]
        velocity[way] = v

    known = {way: has_neighbour(frames, reach[way]).to(times.device)[:, None, None] for way in ("fwd", "bwd")}
    probability = {way: (logits[way] + config["motion.bias"]).sigmoid() for way in ("fwd", "bwd")}
    seen = torch.stack([torch.where(known[way], probability[way], torch.zeros_like(probability[way])) for way in known])
    if config["motion.combine"] == "mean":
        dynamic = seen.sum(0) / (known["fwd"].to(seen.dtype) + known["bwd"]).clamp_min(1)
    else:
        dynamic = seen.amax(0)

    ahead, behind = velocity["fwd"], velocity["bwd"]
    if config["render.extrapolate"] == "mirror":
        ahead, behind = (
            torch.where(known["fwd"][..., None], ahead, -behind),
            torch.where(known["bwd"][..., None], behind, -ahead),
        )
    return ahead, behind, dynamic
