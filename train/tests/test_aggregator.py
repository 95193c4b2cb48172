"""Alternating attention: what the order of frames and of layers may and may not change."""

import torch


def test_permuting_frames_permutes_what_pi3_predicts(case, run):
    order = [2, 0, 1]
    straight, permuted = run(case["pi3"]), run(case["pi3"], frames=order)
    for stage in ("encoder", "aa.3", "camera.t", "camera.rot9", "pose", "point", "conf"):
        assert torch.allclose(straight[stage][order], permuted[stage], atol=1e-11), stage
    assert torch.allclose(straight["k"], permuted["k"])  # shared over the clip


def test_the_time_embedding_breaks_the_symmetry(case, run):
    order = [1, 0, 2, 3]
    straight, permuted = run(case["order"]), run(case["order"], frames=order)
    assert not torch.allclose(straight["aa.3"][order], permuted["aa.3"], atol=1e-3)


def test_with_one_frame_the_order_of_layers_means_nothing(case, run):
    one = case["one_frame"]
    assert torch.allclose(run(one)["aa.3"], run(one, aa__order="global_first")["aa.3"], atol=1e-12)
    assert (run(one)["out.v_fwd"] == 0).all()
    assert (run(one)["out.dynamic"] == 0).all()
    assert not any(stage.startswith(("causal", "motion")) for stage in run(one))


def test_with_more_frames_it_does(case, run):
    pi3 = case["pi3"]
    assert not torch.allclose(run(pi3)["aa.0"], run(pi3, aa__order="global_first")["aa.0"], atol=1e-3)


def test_frame_layers_do_not_look_at_other_frames(case, run):
    pi3 = case["pi3"]
    pair, alone = run(pi3, frames=[0, 1]), run(pi3, frames=[0])
    assert torch.allclose(pair["aa.0"][:1], alone["aa.0"], atol=1e-12)
    assert not torch.allclose(pair["aa.1"][:1], alone["aa.1"], atol=1e-3)
