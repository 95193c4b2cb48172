"""Parameter counts of the published networks: the cheapest proof that the module tree is the right one."""

import pytest
import torch

from streetforward import StreetForward, config as cfg
from streetforward.heads import DptHead


def parameters(module, prefixes=("",)):
    return sum(p.numel() for name, p in module.named_parameters() if name.startswith(tuple(prefixes)))


def on_meta(config):
    with torch.device("meta"):
        return StreetForward(config)


@pytest.mark.parametrize(
    ("config", "total"),
    [
        (cfg.pi3(), 958_696_732),
        (cfg.full(), 1_085_252_555),
        (cfg.with_linear_heads(cfg.full()), 1_156_821_784),
        (cfg.with_linear_heads(cfg.full()) | cfg.no_head("conf"), 1_090_491_988),
        (cfg.with_linear_heads(cfg.base()), 113_829_016),
        (cfg.with_linear_heads(cfg.base()) | cfg.no_head("conf"), 106_212_564),
        (cfg.nano(), 4_398_074),
        (cfg.with_linear_heads(cfg.nano()), 4_262_546),
    ],
)
def test_totals(config, total):
    assert parameters(on_meta(config)) == total


def test_parts_of_full():
    pi3 = on_meta(cfg.pi3())
    assert len(pi3.state_dict()) == 1_208
    assert parameters(pi3, ["encoder."]) == 304_371_712
    assert parameters(pi3, ["decoder.", "register_token"]) == 453_552_128
    assert parameters(pi3, ["camera_head."]) == 2_107_404
    full = on_meta(cfg.full())
    assert parameters(full, ["gs_head."]) == 32_654_859
    assert parameters(full, ["causal."]) == 63_771_264
    assert parameters(full, ["motion_head."]) == 30_129_700


def test_vggt_depth_head():
    with torch.device("meta"):
        head = DptHead(2048, "gs", cfg.full() | {"gs.out": 2})
    assert parameters(head) == 32_654_562


def test_gammas_and_qk_norms_stand_where_they_belong():
    config = cfg.with_linear_heads(cfg.nano())
    names = on_meta(config).state_dict()
    layers = config["encoder.depth"] + config["aa.depth"] + config["causal.depth"]
    gammas = [name for name in names if name.endswith(".gamma")]
    assert len(gammas) == 2 * layers
    assert all(name.startswith(("encoder.blocks.", "decoder.", "causal.")) for name in gammas)
    norms = [name for name in names if "q_norm" in name or "k_norm" in name]
    assert len(norms) == 4 * (config["aa.depth"] + config["causal.depth"])
    assert all(name.startswith(("decoder.", "causal.")) for name in norms)


def test_configuration_survives_json_and_refuses_unknown_keys():
    assert cfg.from_json(cfg.to_json(cfg.nano())) == cfg.nano()
    with pytest.raises(ValueError, match="encoder.dmi is unknown"):
        cfg.from_json('{"encoder.dmi": 3}')
    with pytest.raises(ValueError, match="huge"):
        cfg.preset("huge")
