"""Seeded parameters: the start of training, and random values that leave nothing at zero or one for golden tensors."""

import zlib
from pathlib import Path

import numpy as np
import torch
from safetensors import safe_open
from safetensors.torch import save_file

from . import config as cfg
from . import probe
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


# Module names of the dense heads and the configuration's.
PREFIXES = {"point": "depth", "conf": "conf", "gs": "gs", "motion": "motion"}


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
            if name.startswith(motion_end(config)):
                p.zero_()
        model.camera_head.fc_rot.weight.mul_(0.02)
        model.camera_head.fc_rot.bias.copy_(torch.eye(3).flatten())
    return model


def motion_end(config):
    """Prefixes of the motion head's final layer."""
    if config["motion.kind"] == "guided":
        return "motion_head.conv.3."
    return ("motion_head.proj.", "motion_head.scratch.output_conv2.2.")


# Where a network without pretrained weights starts: ln of a typical street's depth in metres, ln of the focal length
# in image widths and heights at 3:2, travel of a few metres, splats of 0.4 source pixels with opacity 0.95 (each of
# them scores best with true geometry, and an untrained Gaussian head then renders well).
DEPTH_LOG, FOCAL_LOG, SPLAT_LOG, OPACITY_LOGIT = 2.5, (-0.10, 0.30), np.log(0.4 / 0.7), np.log(0.95 / 0.05) - 2


def scratch_start(config, seed):
    """A model as training without pretrained weights starts: open residual branches, output biases at priors."""
    model = training_start(config, seed)
    with torch.no_grad():
        for name, p in model.named_parameters():
            if name.endswith(".gamma") and not name.startswith("encoder."):
                p.fill_(0.5)
        last_layer(model.point_head)[1][-1 if config["depth.out_map"] != "exp_z_conf" else 0] = DEPTH_LOG
        for name in ("point_head", "gs_head"):
            if hasattr(model, name):
                last_layer(getattr(model, name))[0].mul_(0.1)
        if config["gs.kind"] != "none" and config["gs.out_map"] == "residual":
            bias = last_layer(model.gs_head)[1]
            bias[3], bias[4:7] = OPACITY_LOGIT, SPLAT_LOG
        if config["camera.k"] == "fov":
            model.camera_head.fc_fov.weight.mul_(0.1)
            model.camera_head.fc_fov.bias.copy_(torch.tensor(FOCAL_LOG))
    return model


def last_layer(head):
    """Weight and bias of a dense head's final layer, viewed as [out, ...]."""
    if hasattr(head, "conv"):
        end, pixels = head.conv[3], 4
    elif hasattr(head, "scratch"):
        end, pixels = head.scratch.output_conv2[2], 1
    else:
        end, pixels = head.proj, head.patch**2
    return end.weight.view(-1, pixels, *end.weight.shape[1:]), end.bias.view(-1, pixels)


def golden_model(config, seed):
    """A model whose every tensor matters: gains around 1, offsets and biases off zero, open residual branches.

    The last layers are kept small so that the outputs look like a street: depths of a few units, rays inside a field
    of view of about 60 degrees, rotations away from degenerate ones.
    """
    model = StreetForward(config)
    guided = tuple(f"{n}_head." for n, m in PREFIXES.items() if config[f"{m}.kind"] == "guided")
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
                if name.startswith(guided) and name.endswith("_head.proj.weight"):
                    pass
                elif name.endswith(("_head.proj.weight", "_head.conv.3.weight")) or ".output_conv2.2." in name:
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
    if config["depth.kind"] == "guided":
        last_layer(model.point_head)[1][0] += 1.2
        return
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
    if config["gs.kind"] == "guided":
        bias = last_layer(model.gs_head)[1]
        bias[4, 0] += 5
        bias[6, 1] -= 5
    if config["gs.kind"] == "xdec_linear":
        bias = model.gs_head.proj.bias.view(-1, patch, patch)
        bias[4, 0, 0] += 5
        bias[6, 1, 0] -= 5
    if config["gs.kind"] == "none" and config["conf.kind"] == "xdec_linear":
        model.conf_head.proj.bias[0::2] += 0.8
        model.conf_head.proj.bias[1::2] -= 5.2


def write_model(path, model, dtype=None):
    """Writes a model with its configuration, whole or not at all; `dtype` f16 or bf16 stores it smaller."""
    path = Path(path)
    tensors = {
        name: p.detach().to("cpu", dtype).contiguous().clone()
        for name, p in model.state_dict().items()
        if not name.startswith(probe.NAME + ".")
    }
    partial = path.with_name(path.name + ".partial")
    save_file(tensors, partial, {cfg.METADATA_KEY: cfg.to_json(model.config)})
    partial.replace(path)


def read_model(path):
    """The model that a checkpoint describes, in f32."""
    with safe_open(path, "pt") as file:
        metadata = file.metadata() or {}
        if cfg.METADATA_KEY not in metadata:
            raise ValueError(f"{path}: no configuration under {cfg.METADATA_KEY} in its metadata")
        model = StreetForward(cfg.from_json(metadata[cfg.METADATA_KEY]))
        model.load_state_dict({name: file.get_tensor(name).float() for name in file.keys()})
    return model
