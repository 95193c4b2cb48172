"""Output heads: transformer decoder with pixel shuffle (Pi3), the same with image-guided convolutions, DPT pyramid
(VGGT), camera head (Pi3)."""

import torch
import torch.nn.functional as F
from torch import nn

from . import config as cfg
from .blocks import Block, Rope, patch_positions


class Decoder(nn.Module):
    """Frame-local decoder: `projects`, rotary blocks without q/k norm and layer scale, `linear_out`."""

    def __init__(self, inp, dim, depth, heads, out, eps):
        super().__init__()
        self.heads = heads
        self.projects = nn.Linear(inp, dim)
        self.blocks = nn.ModuleList(Block(dim, heads, eps=eps) for _ in range(depth))
        self.linear_out = nn.Linear(dim, out)

    def forward(self, tokens, grid, registers, config):
        """tokens [F, registers + P, inp]; patch tokens [F, P, out]."""
        positions = patch_positions(*grid, registers).to(tokens.device)
        x = self.projects(tokens)
        rope = Rope(positions, x.shape[-1] // self.heads, config)
        for block in self.blocks:
            x = block(x, rope)
        return self.linear_out(x)[:, registers:]


class PixelShuffleHead(nn.Module):
    """One linear layer per patch token; output c*p*p + dy*p + dx is pixel (dy, dx) of channel c."""

    def __init__(self, dim, out, patch):
        super().__init__()
        self.patch = patch
        self.proj = nn.Linear(dim, out * patch * patch)

    def forward(self, tokens, grid):
        """tokens [F, P, dim]; [F, H, W, out]."""
        p, (rows, columns) = self.patch, grid
        x = self.proj(tokens).unflatten(1, (rows, columns)).unflatten(-1, (-1, p, p))  # [F, y, x, c, dy, dx]
        return x.permute(0, 1, 4, 2, 5, 3).flatten(3, 4).flatten(1, 2)


class GuidedHead(nn.Module):
    """Patch tokens to half-resolution features, joined with the image's, refined by 3x3 convolutions.

    `proj` output c*(p/2)^2 + dy*(p/2) + dx is feature c of half-resolution pixel (dy, dx) of its patch; the last
    convolution's output c*4 + dy*2 + dx is channel c of image pixel (dy, dx) of its half-resolution pixel.
    """

    def __init__(self, prefix, config):
        super().__init__()
        if config["patch"] % 2 or not config["guide.channels"]:
            raise ValueError(f"{prefix}.kind = guided needs an even patch and guide.channels above 0")
        self.half = config["patch"] // 2
        hidden, features = config[f"{prefix}.hidden"], config[f"{prefix}.features"]
        self.proj = nn.Linear(config[f"{prefix}.dim"], hidden * self.half**2)
        widths = [
            (hidden + config["guide.channels"], features),
            (features, features),
            (features, features),
            (features, 4 * config[f"{prefix}.out"]),
        ]
        self.conv = nn.ModuleList(nn.Conv2d(a, b, 3, padding=1) for a, b in widths)

    def forward(self, tokens, grid, guide):
        """tokens [F, P, dim], guide [F, guide, H/2, W/2]; [F, H, W, out]."""
        x = self.proj(tokens).transpose(1, 2).unflatten(2, grid)
        x = torch.cat((F.pixel_shuffle(x, self.half), guide), dim=1)
        x = F.relu(self.conv[0](x))
        y = F.relu(self.conv[1](x))
        y = F.relu(x + self.conv[2](y))
        return F.pixel_shuffle(self.conv[3](y), 2).permute(0, 2, 3, 1)


class ImageStem(nn.Conv2d):
    """What every guided head sees of the image: one strided convolution and ReLU, [F, 3, H, W] to [F, C, H/2, W/2]."""

    def __init__(self, channels):
        super().__init__(3, channels, 3, stride=2, padding=1)

    def forward(self, x):
        return F.relu(super().forward(x))


def uv_embedding(channels, size, aspect):
    """Sinusoidal position map [channels, h, w] in f64 of an h x w map of an image with aspect W / H.

    u runs over the columns and v over the rows of a grid whose half diagonal is 1. Channels: sin(u w), cos(u w),
    sin(v w), cos(v w), a quarter each, with frequencies w_i = 100^(-i / (channels / 4)).
    """
    diagonal = (1 + aspect**2) ** 0.5
    quarter = channels // 4
    omega = 100.0 ** (-torch.arange(quarter, dtype=torch.float64) / quarter)

    def axis(n, span):
        end = span * (n - 1) / n
        return omega[:, None] * torch.linspace(-end, end, n, dtype=torch.float64)  # [quarter, n]

    height, width = size
    u = axis(width, aspect / diagonal)[:, None, :].expand(-1, height, -1)
    v = axis(height, 1 / diagonal)[:, :, None].expand(-1, -1, width)
    return torch.cat((u.sin(), u.cos(), v.sin(), v.cos()))


def add_uv(x, aspect):
    """x [F, C, h, w] plus a tenth of its position map."""
    return x + 0.1 * uv_embedding(x.shape[1], x.shape[2:], aspect).to(x)


def resize(x, size):
    """Bilinear, corner pixels on corner pixels."""
    return F.interpolate(x, size=tuple(size), mode="bilinear", align_corners=True)


class ResidualUnit(nn.Module):
    """conv2(relu(conv1(relu x))) plus a skip: relu(x) as VGGT's in-place activation executes it, or x (`raw`)."""

    def __init__(self, features, skip):
        super().__init__()
        self.skip = skip
        self.conv1 = nn.Conv2d(features, features, 3, padding=1)
        self.conv2 = nn.Conv2d(features, features, 3, padding=1)

    def forward(self, x):
        r = F.relu(x)
        return self.conv2(F.relu(self.conv1(r))) + (r if self.skip == "relu" else x)


class Refine(nn.Module):
    """One fusion step, coarse to fine; the coarsest has no lateral input."""

    def __init__(self, features, skip, lateral):
        super().__init__()
        self.out_conv = nn.Conv2d(features, features, 1)
        if lateral:
            self.resConfUnit1 = ResidualUnit(features, skip)
        self.resConfUnit2 = ResidualUnit(features, skip)

    def forward(self, top, size, lateral=None):
        if lateral is not None:
            top = top + self.resConfUnit1(lateral)
        return self.out_conv(resize(self.resConfUnit2(top), size))


class Scratch(nn.Module):
    """Container with VGGT's tensor names."""

    def __init__(self, channels, features, hidden, out, skip):
        super().__init__()
        for i, c in enumerate(channels, start=1):
            setattr(self, f"layer{i}_rn", nn.Conv2d(c, features, 3, padding=1, bias=False))
        for i in range(1, 5):
            setattr(self, f"refinenet{i}", Refine(features, skip, lateral=i < 4))
        self.output_conv1 = nn.Conv2d(features, features // 2, 3, padding=1)
        self.output_conv2 = nn.Sequential(
            nn.Conv2d(features // 2, hidden, 3, padding=1), nn.ReLU(), nn.Conv2d(hidden, out, 1)
        )


class DptHead(nn.Module):
    """Four taps on one patch grid, resized to 4x, 2x, 1x and 1/2x of it, fused from coarse to fine."""

    def __init__(self, inp, prefix, config):
        super().__init__()
        channels = config[f"{prefix}.channels"]
        self.norm = nn.LayerNorm(inp, eps=config[f"{prefix}.eps"])
        self.projects = nn.ModuleList(nn.Conv2d(inp, c, 1) for c in channels)
        self.resize_layers = nn.ModuleList(
            (
                nn.ConvTranspose2d(channels[0], channels[0], 4, stride=4),
                nn.ConvTranspose2d(channels[1], channels[1], 2, stride=2),
                nn.Identity(),
                nn.Conv2d(channels[3], channels[3], 3, stride=2, padding=1),
            )
        )
        self.scratch = Scratch(
            channels,
            config[f"{prefix}.features"],
            config[f"{prefix}.hidden"],
            config[f"{prefix}.out"],
            config[f"{prefix}.rcu_skip"],
        )

    def forward(self, taps, grid, patch):
        """taps: four [F, P, inp]; [F, H, W, out]."""
        rows, columns = grid
        aspect = columns / rows
        s = self.scratch
        laterals = []
        for i, (tap, project, change) in enumerate(zip(taps, self.projects, self.resize_layers), start=1):
            x = self.norm(tap).transpose(1, 2).unflatten(2, (rows, columns))
            laterals.append(getattr(s, f"layer{i}_rn")(change(add_uv(project(x), aspect))))
        l1, l2, l3, l4 = laterals
        x = s.refinenet4(l4, l3.shape[2:])
        x = s.refinenet3(x, l2.shape[2:], l3)
        x = s.refinenet2(x, l1.shape[2:], l2)
        x = s.refinenet1(x, (8 * rows, 8 * columns), l1)
        x = resize(s.output_conv1(x), (patch * rows, patch * columns))
        return s.output_conv2(add_uv(x, aspect)).permute(0, 2, 3, 1)


class CameraUnit(nn.Module):
    """x + relu(L3 relu(L2 relu(L1 x)))."""

    slope = 0.0  # see CameraHead

    def __init__(self, width):
        super().__init__()
        self.res_conv1 = nn.Linear(width, width)
        self.res_conv2 = nn.Linear(width, width)
        self.res_conv3 = nn.Linear(width, width)

    def forward(self, x):
        y = F.leaky_relu(self.res_conv1(x), self.slope)
        y = F.leaky_relu(self.res_conv2(y), self.slope)
        return x + F.leaky_relu(self.res_conv3(y), self.slope)


class CameraHead(nn.Module):
    """Patch tokens [F, P, width] to translation [F, 3], rotation numbers [F, 9] and, if asked, field of view [F, 2].

    The network's units are ReLU, `slope` 0. Training may let negative inputs leak for a while: behind the average over
    patches most units would otherwise be off for all frames, with no gradient to come back.
    """

    slope = 0.0

    def __init__(self, config):
        super().__init__()
        width = config["camera.width"]
        self.res_conv = nn.ModuleList((CameraUnit(width), CameraUnit(width)))
        self.more_mlps = nn.Sequential(nn.Linear(width, width), nn.ReLU(), nn.Linear(width, width), nn.ReLU())
        self.fc_t = nn.Linear(width, 3)
        self.fc_rot = nn.Linear(width, 9)
        if config["camera.k"] == "fov":
            self.fc_fov = nn.Linear(width, 2)

    def forward(self, x):
        for unit in self.res_conv:
            x = unit(x)
        x = x.mean(dim=1)
        for layer in self.more_mlps[0], self.more_mlps[2]:
            x = F.leaky_relu(layer(x), self.slope)
        fov = self.fc_fov(x) if hasattr(self, "fc_fov") else None
        return self.fc_t(x), self.fc_rot(x), fov

    def leak(self, slope):
        """Sets the slope of all units on negative inputs."""
        self.slope = slope
        for unit in self.res_conv:
            unit.slope = slope


def nearest_rotation(nine):
    """nine [..., 9], a row-major 3x3 matrix, to the rotation [..., 3, 3] nearest to it after its rows are normalised.

    In f64. With svd(M) = U S V^T the answer is U diag(1, 1, det(U V^T)) V^T: a reflection is undone on the axis of
    the smallest singular value.
    """
    m = nine.to(torch.float64).unflatten(-1, (3, 3))
    m = m / m.norm(dim=-1, keepdim=True).clamp_min(1e-12)
    u, _, vt = torch.linalg.svd(m)
    flip = torch.ones(m.shape[:-1], dtype=m.dtype, device=m.device)
    flip[..., 2] = torch.linalg.det(u @ vt).sign()
    return (u * flip[..., None, :]) @ vt


def add_head(model, name, prefix, inp, config):
    """Puts the modules of a dense head on `model` under its public tensor names; nothing for kind `none`."""
    kind = config[f"{prefix}.kind"]
    if kind in ("xdec_linear", "guided"):
        dim, depth, heads = (config[f"{prefix}.{key}"] for key in ("dim", "depth", "heads"))
        setattr(model, f"{name}_decoder", Decoder(inp, dim, depth, heads, dim, config[f"{prefix}.eps"]))
        if kind == "guided":
            setattr(model, f"{name}_head", GuidedHead(prefix, config))
        else:
            setattr(model, f"{name}_head", PixelShuffleHead(dim, config[f"{prefix}.out"], config["patch"]))
    elif kind == "dpt":
        setattr(model, f"{name}_head", DptHead(inp, prefix, config))
    elif kind != "none":
        raise ValueError(f"{prefix}.kind = {kind} is known but not executed")


def aa_head_in(prefix, config):
    """Input channels of a dense head on the alternating-attention features; DPT always reads pairs."""
    return 2 * config["aa.dim"] if config[f"{prefix}.kind"] == "dpt" else cfg.head_in(config)
