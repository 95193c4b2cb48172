"""Fine-tuning through drawn images. Needs the rasterizer's library: `cargo build --release -p sf-capi`."""

import json

import pytest
import torch
from safetensors.torch import save_file

from streetforward import config as cfg
from streetforward import finetune
from streetforward.weights import read_model, scratch_start, write_model

try:
    from streetforward import raster

    raster._load()
except FileNotFoundError as missing:
    pytest.skip(str(missing), allow_module_level=True)


def arguments(tmp_path, generator, *more):
    given = ["--model", tmp_path / "start.safetensors", "--out", tmp_path / "run", "--cache", tmp_path, "--size", "42x28"]
    given += ["--generator", generator, "--frames", 4, "--context", "0,1,3", "--window", 8, "--minutes", 1000, "--log-every", 1]
    given += ["--eval-clips", 1, "--eval-every", 1, "--batch", 1, *more]
    return [str(a) for a in given]


def test_only_the_named_part_moves_and_every_loss_is_there(tmp_path, generator):
    model = scratch_start(cfg.nano(), 3)
    with torch.no_grad():  # half of all pixels travel, so that motion has losses
        model.motion_head.conv[3].bias[0::4].fill_(0.2)
        model.motion_head.conv[3].bias[12:].copy_(torch.tensor([3.0, -3.0, 3.0, -3.0]))
    write_model(tmp_path / "start.safetensors", model)
    losses = ["--depth", 0.05, "--rigid-2d", 0.01, "--rigid-3d", 0.01, "--fb", 0.01, "--labels", 0.1]
    finetune.main(arguments(tmp_path, generator, "--steps", 2, "--unfreeze", "gs_=0", *losses))
    log = [json.loads(line) for line in (tmp_path / "run" / "log.jsonl").read_text().splitlines()]
    step = next(entry for entry in log if "step" in entry)
    assert all(0 < step[name] < 1e3 for name in ("rgb", "alpha", "rigid_2d", "rigid_3d", "labels")), step
    assert step["fb"] < 1e-5  # both passes see the same bias, and the backward one is negated
    measured = [entry for entry in log if entry.get("event") == "eval"]
    assert len(measured) == 2 and all(3 < entry["inside_drawn"] < 60 for entry in measured)
    after = read_model(tmp_path / "run" / "ema.safetensors").state_dict()
    changed = {name for name, value in model.state_dict().items() if not torch.equal(value, after[name])}
    assert changed and all(name.startswith("gs_") for name in changed)


def test_colours_learn_from_a_drawn_image(tmp_path, generator):
    write_model(tmp_path / "start.safetensors", scratch_start(cfg.nano(), 3))
    finetune.main(arguments(tmp_path, generator, "--steps", 12, "--window", 1, "--reuse", 1000, "--lr", 3e-3))
    log = [json.loads(line) for line in (tmp_path / "run" / "log.jsonl").read_text().splitlines()]
    rgb = [entry["rgb"] for entry in log if "step" in entry]
    assert sum(rgb[-3:]) < 0.97 * sum(rgb[:3]), rgb


def test_a_checkpoint_of_another_network_gives_what_fits(tmp_path):
    own = scratch_start(cfg.nano(), 4).state_dict()
    part = {name: value for name, value in own.items() if name.startswith(("encoder.", "decoder."))}
    part["decoder.0.attn.qkv.weight"] = torch.zeros(3, 3)
    save_file(part, tmp_path / "part.safetensors")
    model, missing = finetune.start_from(tmp_path / "part.safetensors", "nano", 1)
    assert torch.equal(model.encoder.pos_embed, own["encoder.pos_embed"])
    assert "decoder.0.attn.qkv.weight" in missing and "gs_head.proj.weight" in missing
    assert not any(name.startswith("encoder.") for name in missing)
    save_file({"other": torch.zeros(1)}, tmp_path / "other.safetensors")
    with pytest.raises(ValueError, match="no tensor"):
        finetune.start_from(tmp_path / "other.safetensors", "nano", 1)
