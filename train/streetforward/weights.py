"""Seeded parameters: the start of training, and random values that leave nothing at zero or one for golden tensors."""

import zlib

import numpy as np
import torch

from . import config as cfg
from .model import StreetForward


def generator(seed, name):
    """An independent stream per tensor: adding a tensor changes no other one."""
    return np.random.Generator(np.random.PCG64([seed, zlib.crc32(name.encode())]))


def normal(seed, name, shape):
    return torch.from_numpy(generator(seed, name).standard_normal(tuple(shape), dtype=np.float32))


def fan_in(name, shape):
    """Inputs that one output of a weight sums over; transposed convolutions store [in, out, k, k]."""
    if ".resize_layers.0." in name or ".resize_layers.1." in name:
        return shape[0]
    return int(np.prod(shape[1:]))


def is_norm(name):
    return name.split(".")[-2:-1] in (["norm"], ["norm1"], ["norm2"], ["q_norm"], ["k_norm"])


def is_table(name):
    return name.split(".")[-1] in ("cls_token", "pos_embed", "register_tokens", "register_token")


def training_start(config, seed):
    """A model as training starts: residual branches nearly closed, motion output exactly zero."""
    model = StreetForward(config)
    with torch.no_grad():
        for name, p in model.named_parameters():
            if name.endswith(".gamma") or is_norm(name):
                continue
            if is_table(name):
                p.copy_(0.02 * normal(seed, name, p.shape))
            elif name.endswith(".bias"):
                p.zero_()
            else:
                p.copy_(normal(seed, name, p.shape) / fan_in(name, p.shape) ** 0.5)
        for name, p in model.named_parameters():
            if name.startswith(("motion_head.proj.", "motion_head.scratch.output_conv2.2.")):
                p.zero_()
        model.camera_head.fc_rot.weight.mul_(0.02)
        model.camera_head.fc_rot.bias.copy_(torch.eye(3).flatten())
    return model


def golden_model(config, seed):
    """A model whose every tensor matters: gains around 1, offsets and biases off zero, open residual branches.

    The last layers are kept small so that the outputs look like a street: depths of a few units, rays inside a field
    of view of about 60 degrees, rotations away from degenerate ones.
    """
    model = StreetForward(config)
    with torch.no_grad():
        for name, p in model.named_parameters():
            x = normal(seed, name, p.shape)
            if name.endswith(".gamma"):
                x = 0.3 + 0.1 * x
            elif is_norm(name):
                x = 1 + 0.2 * x if name.endswith(".weight") else 0.1 * x
            elif is_table(name):
                x = 0.5 * x
            elif name.endswith(".bias"):
                x = 0.15 * x
            else:
                x = x / fan_in(name, p.shape) ** 0.5
                if name.endswith("_head.proj.weight") or ".output_conv2.2." in name:
                    x = 0.12 * x
                elif ".fc_" in name:
                    x = 0.3 * x
            p.copy_(x)
        point_bias(model, config)
        edge_bias(model, config)
        rotation = torch.eye(3)
        if seed % 2:  # a reflection with well separated singular values: the projection has to undo it
            rotation = torch.tensor([[1.0, 0.1, 0.0], [0.6, 0.8, 0.1], [0.3, 0.2, -0.5]])
        model.camera_head.fc_rot.bias.add_(rotation.flatten())
        if config["camera.k"] == "fov":
            model.camera_head.fc_fov.bias.add_(torch.tensor([-0.1, 0.2]))
    return model


def point_bias(model, config):
    """Depth near 3.5 units; inside each patch the rays run as those of a camera, so that the fit of K has a slope."""
    patch = config["patch"]
    if config["depth.kind"] == "dpt":
        model.point_head.scratch.output_conv2[2].bias[-1] += 1.2
        return
    proj = model.point_head.proj
    bias, weight = proj.bias.view(-1, patch, patch), proj.weight.view(-1, patch, patch, proj.in_features)
    bias[-1] += 1.2
    if len(bias) == 3:
        bias[:2] *= 0.3
        weight[:2] *= 0.3
        ramp = (torch.arange(patch) + 0.5) / patch - 0.5
        bias[0] += 0.6 * ramp
        bias[1] += 0.6 * ramp[:, None]


def edge_bias(model, config):
    """Reaches both ends of the Gaussian scale's clamp and, where confidence decides, both sides of its cut at -2.2."""
    patch = config["patch"]
    if config["gs.kind"] == "xdec_linear":
        bias = model.gs_head.proj.bias.view(-1, patch, patch)
        bias[4, 0, 0] += 5
        bias[6, 1, 0] -= 5
    if config["gs.kind"] == "none" and config["conf.kind"] == "xdec_linear":
        model.conf_head.proj.bias[0::2] += 0.8
        model.conf_head.proj.bias[1::2] -= 5.2
