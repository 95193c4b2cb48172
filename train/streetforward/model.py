"""The whole network: a clip of frames to cameras, depth, Gaussians and motion."""

import torch
from torch import nn

from . import config as cfg
from . import gaussians as g
from .aggregator import aa_blocks, aggregate, last_features
from .causal import causal_blocks, pass_ranges, run_pass, time_embedding
from .encoder import Encoder
from .heads import CameraHead, Decoder, ImageStem, aa_head_in, add_head, nearest_rotation


class StreetForward(nn.Module):
    """StreetForward with the sizes and conventions of a configuration dictionary.

    `state_dict()` has the public tensor names: Pi3's for what Pi3 has, `gs_*`, `causal.*`, `motion_*` and `aa_time`
    for the rest, VGGT's DPT names inside DPT heads.
    """

    def __init__(self, config):
        super().__init__()
        self.config = config
        dim = config["aa.dim"]
        self.encoder = Encoder(config)
        registers = config["aa.registers"]
        self.register_token = nn.Parameter(torch.zeros(1, 1, registers, dim)) if registers else None
        if config["aa.time"]:
            self.aa_time = nn.Linear(config["time.d_t"], dim)
        self.decoder = aa_blocks(config)

        camera = [config[f"camera.{key}"] for key in ("dim", "depth", "heads", "width")]
        self.camera_decoder = Decoder(cfg.head_in(config), *camera, config["aa.eps"])
        self.camera_head = CameraHead(config)
        if cfg.guided(config):
            self.image_stem = ImageStem(config["guide.channels"])
        for name, prefix in (("point", "depth"), ("conf", "conf"), ("gs", "gs")):
            add_head(self, name, prefix, aa_head_in(prefix, config), config)

        if cfg.has_motion(config):
            self.causal = causal_blocks(config)
            if not config["causal.share"]:
                self.causal_back = causal_blocks(config)
            add_head(self, "motion", "motion", cfg.causal_dim(config), config)

    @property
    def dtype(self):
        """The arithmetic: the parameters' type."""
        return self.encoder.cls_token.dtype

    def forward(self, images, times, stages=None):
        """images u8 [F, H, W, 3], H and W multiples of the patch; times f64 [F] seconds.

        Returns the outputs by name: pose, depth, mean, scale, quat, opacity, colour, v_fwd, v_bwd, dynamic. Every
        intermediate stage is put into the dictionary `stages` if one is given.
        """
        config = self.config
        frames, height, width, _ = images.shape
        if frames < 1 or height % config["patch"] or width % config["patch"]:
            size = f"{frames} frames of {width}x{height}"
            raise ValueError(f"{size}: need one or more, sides multiples of {config['patch']}")
        if len(times) != frames:
            raise ValueError(f"{len(times)} times for {frames} frames")
        grid = height // config["patch"], width // config["patch"]

        def note(name, tensor):
            if stages is not None:
                stages[name] = tensor
            return tensor

        image = images.to(self.dtype) / 255
        mean, std = (torch.tensor(config[f"image.{key}"]).to(image) for key in ("mean", "std"))
        normal = ((image - mean) / std).permute(0, 3, 1, 2)
        patches = self.encoder(normal, note)
        guide = self.image_stem(normal) if cfg.guided(config) else None
        if guide is not None:
            note("guide", guide.permute(0, 2, 3, 1))

        time = None
        if config["time.d_t"]:
            time = note("time", time_embedding(times, config).to(self.dtype))
        layers = self.alternate(patches, time, grid, note)

        translation, nine, fov = self.camera(layers, grid, note)
        raw = self.dense("point", "depth", layers, grid, guide)
        conf = None
        if config["depth.out_map"] == "exp_z_conf":
            raw, conf = raw[..., :1], note("conf", raw[..., 1])
        elif config["conf.kind"] != "none":
            conf = note("conf", self.dense("conf", "conf", layers, grid, guide)[..., 0])
        point = note("point", self.points(raw))
        k = note("k", g.intrinsics(point, fov, config))
        own_pose = note("pose", g.raw_poses(nearest_rotation(nine), translation))
        pose = g.anchored_poses(own_pose, config)
        depth = point[..., -1]

        colour, opacity, scale, quat = self.appearance(layers, image, guide, conf, depth, k, pose, grid, note)
        velocity_fwd, velocity_bwd, dynamic = self.motion(layers, time, times, pose, grid, guide, note)
        scene_depth = depth * config["world.scale"]
        outputs = {
            "pose": pose,
            "depth": scene_depth,
            "mean": g.unproject(scene_depth, k, pose, config),
            "scale": scale,
            "quat": quat,
            "opacity": opacity,
            "colour": colour,
            "v_fwd": velocity_fwd,
            "v_bwd": velocity_bwd,
            "dynamic": dynamic,
        }
        for name, tensor in outputs.items():
            note(f"out.{name}", tensor)
        return outputs

    def alternate(self, patches, time, grid, note):
        """Patch tokens [F, P, C] through the alternating stack: every layer's output [F, registers + P, C]."""
        tokens = patches
        if self.register_token is not None:
            tokens = torch.cat((self.register_token[0].expand(len(patches), -1, -1), patches), dim=1)
        if self.config["aa.time"]:
            tokens = tokens + self.aa_time(time)[:, None]
        return aggregate(self.decoder, tokens, grid, self.config, note)

    def camera(self, layers, grid, note):
        """Translation [F, 3], rotation numbers [F, 9], field of view [F, 2] or None."""
        tokens = last_features(layers, self.config["head.concat"])
        tokens = self.camera_decoder(tokens, grid, self.config["aa.registers"], self.config)
        translation, nine, fov = self.camera_head(tokens)
        return note("camera.t", translation), note("camera.rot9", nine), fov

    def points(self, raw):
        """Local points [F, H, W, 3] in camera axes (a z, b z, z) with z = exp(l), or z alone [F, H, W, 1]."""
        z = raw[..., -1:].exp()
        return torch.cat((raw[..., :-1] * z, z), dim=-1)

    def dense(self, name, prefix, layers, grid, guide):
        """Raw channels [F, H, W, out] of a head on the alternating-attention features."""
        config, registers = self.config, self.config["aa.registers"]
        if config[f"{prefix}.kind"] == "dpt":
            pairs = [torch.cat(layers[2 * j : 2 * j + 2], dim=-1)[:, registers:] for j in config[f"{prefix}.taps"]]
            return getattr(self, f"{name}_head")(pairs, grid, config["patch"])
        tokens = last_features(layers, config["head.concat"])
        tokens = getattr(self, f"{name}_decoder")(tokens, grid, registers, config)
        head = getattr(self, f"{name}_head")
        return head(tokens, grid, guide) if config[f"{prefix}.kind"] == "guided" else head(tokens, grid)

    def appearance(self, layers, image, guide, conf, depth, k, pose, grid, note):
        """Colour, opacity, scale and quaternion per pixel; priors alone when there is no Gaussian head."""
        if self.config["gs.kind"] != "none":
            raw = note("gs.raw", self.dense("gs", "gs", layers, grid, guide))
            return g.gaussian_maps(raw, image, depth, k, pose, self.config)
        raw = image.new_zeros(*image.shape[:3], 11)
        priors = self.config | {"gs.out_map": "residual"}
        colour, opacity, scale, quat = g.gaussian_maps(raw, image, depth, k, pose, priors)
        if conf is not None:  # Pi3's own cut
            opacity = torch.where(conf.sigmoid() < self.config["sky.conf"], torch.zeros_like(opacity), opacity)
        return colour, opacity, scale, quat

    def motion(self, layers, time, times, pose, grid, guide, note):
        """Velocities and dynamic probability; zero without a motion head or with one frame alone."""
        config = self.config
        frames, rows, columns = len(times), grid[0] * config["patch"], grid[1] * config["patch"]
        if not cfg.has_motion(config) or frames == 1:
            still = layers[0].new_zeros(frames, rows, columns, 3)
            return still, still, still[..., 0]

        tokens = last_features(layers, config["causal.in"])
        if not config["causal.registers"]:
            tokens = tokens[:, config["aa.registers"] :]
        if time is not None:
            tokens = torch.cat((tokens, time[:, None].expand(-1, tokens.shape[1], -1)), dim=-1)
        raw = {}
        for way, reach in pass_ranges(config).items():
            blocks = self.causal_back if way == "bwd" and not config["causal.share"] else self.causal
            outputs = run_pass(blocks, tokens, reach, grid, config)
            for i, output in enumerate(outputs):
                note(f"causal.{way}.{i}", output)
            raw[way] = note(f"motion.{way}", self.motion_raw(outputs, grid, guide))
        return g.motion_maps(raw, times, pose, config)

    def motion_raw(self, outputs, grid, guide):
        """Raw motion channels [F, H, W, out] of one pass."""
        config = self.config
        if config["motion.kind"] == "dpt":
            return self.motion_head([outputs[j] for j in config["motion.taps"]], grid, config["patch"])
        tokens = self.motion_decoder(outputs[-1], grid, 0, config)
        return self.motion_head(tokens, grid, guide) if config["motion.kind"] == "guided" else self.motion_head(tokens, grid)
