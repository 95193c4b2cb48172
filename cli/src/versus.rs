//! One model against another on clips: what `compare` and the checks of `convert` share.

use crate::args::EngineArgs;
use crate::reconstruct;
use serde_json::{Map, Value, json};
use sf_eval::{Comparison, Gate, INT8_GATES, Side, StageMatch};
use sf_formats::clip::Clip;
use sf_formats::{Error, Result};
use sf_splat::Renderer;
use std::collections::BTreeMap;
use std::sync::Arc;
use streetforward::{Model, Output, Prepared, Tap};

/// A clip at the network's size.
pub(crate) struct Sample {
    /// As input.
    pub(crate) prepared: Prepared,
}

/// Clips for two models of one network.
pub(crate) fn samples(model: &Model, clips: &[Clip], size: Option<crate::args::Size>) -> Result<Vec<Sample>> {
    let config = model.config();
    let sample = |clip: &Clip| -> Result<Sample> {
        let size = reconstruct::network_size(config, clip, size);
        Ok(Sample { prepared: reconstruct::prepare_clip(config, clip, None, size)? })
    };
    clips.iter().map(sample).collect()
}

/// Values of every stage of a run, in the order they appear; frames apart.
type Stages = Vec<(String, usize, Vec<f32>)>;

/// A model's answers to all samples.
pub(crate) struct Answers {
    outputs: Vec<Output>,
    stages: Vec<Stages>,
    /// Wall time of all runs.
    pub(crate) run_ms: f64,
}

/// Runs a model on all samples; `stages` keeps everything inside, too.
pub(crate) fn answers(model: &Arc<Model>, samples: &[Sample], engine: &EngineArgs, stages: bool) -> Result<Answers> {
    let mut answers = Answers { outputs: Vec::new(), stages: Vec::new(), run_ms: 0.0 };
    for sample in samples {
        let mut session = reconstruct::session_of(model, sample.prepared.shape, engine)?;
        let start = std::time::Instant::now();
        let mut seen: Stages = Vec::new();
        let mut tap = |t: &Tap| seen.push((t.name.to_string(), *t.shape.last().unwrap_or(&1), t.data.to_vec()));
        session.run_watched(&sample.prepared.input(), None, stages.then_some(&mut tap))?;
        answers.run_ms += start.elapsed().as_secs_f64() * 1e3;
        answers.outputs.push(session.output().clone());
        answers.stages.push(seen);
    }
    Ok(answers)
}

/// What a comparison found.
pub(crate) struct Verdict {
    /// Outputs by key.
    pub(crate) outputs: Vec<(&'static str, Option<f64>)>,
    /// Stages by name, in the order of the network.
    pub(crate) stages: Vec<(String, StageMatch)>,
}

/// Compares B's answers with A's.
pub(crate) fn compare(
    samples: &[Sample],
    (model_a, a): (&Model, &Answers),
    (model_b, b): (&Model, &Answers),
    renderer: &mut Renderer,
) -> Result<Verdict> {
    let mut comparison = Comparison::default();
    let mut order: Vec<String> = Vec::new();
    let mut matches: BTreeMap<String, StageMatch> = BTreeMap::new();
    for i in 0..a.outputs.len() {
        let (out_a, out_b) = (&a.outputs[i], &b.outputs[i]);
        let (scene_a, scene_b) = (out_a.to_scene(model_a.config(), &[]), out_b.to_scene(model_b.config(), &[]));
        comparison.add(&side(out_a, &scene_a), &side(out_b, &scene_b), &samples[i].prepared.images, renderer)?;
        for ((name, width, a), (other, _, b)) in a.stages[i].iter().zip(&b.stages[i]) {
            if name != other || a.len() != b.len() {
                return Err(Error::Internal(format!("stage {name} of A, {other} of B")));
            }
            if !matches.contains_key(name) {
                order.push(name.clone());
            }
            matches.entry(name.clone()).or_default().add(a, b, *width);
        }
    }
    let stages = order.into_iter().map(|name| (name.clone(), matches[&name])).collect();
    Ok(Verdict { outputs: comparison.outputs(), stages })
}

fn side<'a>(out: &'a Output, scene: &'a sf_formats::Scene) -> Side<'a> {
    Side {
        poses: &out.poses,
        k: &out.k,
        depth: &out.depth,
        v_fwd: &out.v_fwd,
        v_bwd: &out.v_bwd,
        dynamic: &out.dynamic,
        opacity: &out.opacity,
        colour: &out.colour,
        scale: &out.scale,
        scene,
    }
}

/// Two models can be compared when they are one network.
pub(crate) fn check_same(a: &Model, b: &Model) -> Result<()> {
    let differs = a.config().to_pairs().into_iter().zip(b.config().to_pairs()).find(|(a, b)| a != b);
    match differs {
        None => Ok(()),
        Some((a, b)) => Err(Error::usage(format!(
            "the two models are different networks: {} is {:?} in A, {:?} in B",
            a.0, a.1, b.1
        ))),
    }
}

/// The gates of an int8 model.
pub(crate) fn int8_gates() -> Vec<Gate> {
    INT8_GATES.into_iter().map(|(key, limit)| Gate { key: key.into(), limit }).collect()
}

/// One bound of `--gate`, or `int8` for all of its gates. Keys may leave their `_db` out.
pub(crate) fn parse_gate(text: &str) -> Result<Vec<Gate>, String> {
    if text == "int8" {
        return Ok(int8_gates());
    }
    let known = Comparison::default().outputs();
    let gate = text.split_once('=').and_then(|(key, value)| {
        let key = known.iter().map(|(k, _)| *k).find(|k| *k == key || k.strip_suffix("_db") == Some(key))?;
        let limit: f64 = value.parse().ok().filter(|v: &f64| v.is_finite() && *v > 0.0)?;
        Some(vec![Gate { key: key.to_string(), limit }])
    });
    gate.ok_or_else(|| {
        let keys: Vec<&str> = known.iter().map(|(k, _)| *k).collect();
        format!("a gate is KEY=LIMIT with a limit above 0, or int8; keys: {}", keys.join(", "))
    })
}

/// The largest of all gates' loads ([`Gate::load`]).
pub(crate) fn load(gates: &[Gate], verdict: &Verdict) -> f64 {
    gates.iter().map(|g| g.load(&verdict.outputs)).fold(0.0, f64::max)
}

/// Gates that did not pass, as text.
pub(crate) fn failures(gates: &[Gate], verdict: &Verdict) -> Vec<String> {
    let value = |g: &Gate| verdict.outputs.iter().find(|(k, _)| *k == g.key).and_then(|(_, v)| *v);
    gates
        .iter()
        .filter(|g| g.load(&verdict.outputs) > 1.0)
        .map(|g| format!("{} is {:.5}, wanted {}", g.key, value(g).unwrap_or(f64::NAN), g.describe()))
        .collect()
}

/// Outputs, stages and gates as JSON.
pub(crate) fn to_json(gates: &[Gate], verdict: &Verdict) -> Value {
    let outputs: Map<String, Value> = verdict.outputs.iter().map(|(k, v)| (k.to_string(), json!(v))).collect();
    let stages = verdict.stages.iter().map(|(name, m)| {
        json!({ "name": name, "cosine": m.cosine(), "cosine_min": m.lowest_cosine(), "sqnr_db": m.sqnr_db() })
    });
    let gates_json = gates.iter().map(|g| {
        let load = g.load(&verdict.outputs);
        json!({ "key": g.key, "limit": g.limit, "pass": load <= 1.0 })
    });
    json!({
        "outputs": outputs,
        "stages": stages.collect::<Value>(),
        "gates": gates_json.collect::<Value>(),
        "pass": failures(gates, verdict).is_empty(),
    })
}

/// For people: outputs with their gates; the weakest stages.
pub(crate) fn to_text(gates: &[Gate], verdict: &Verdict) -> String {
    let mut text = String::new();
    for (key, value) in &verdict.outputs {
        let shown = value.map_or_else(|| "-".to_string(), |v| format!("{v:.5}"));
        let gate = gates.iter().find(|g| g.key == *key).map_or_else(String::new, |g| {
            let mark = if g.load(&verdict.outputs) <= 1.0 { "pass" } else { "FAIL" };
            format!("  {mark} ({})", g.describe())
        });
        text.push_str(&format!("{key:<24} {shown:>12}{gate}\n"));
    }
    if !verdict.stages.is_empty() {
        text.push_str(&format!("{:<24} {:>12} {:>12} {:>9}\n", "stage", "cosine", "lowest", "sqnr dB"));
    }
    for (name, m) in &verdict.stages {
        let lowest = m.lowest_cosine().map_or_else(|| "-".to_string(), |l| format!("{l:.6}"));
        text.push_str(&format!("{name:<24} {:>12.7} {lowest:>12} {:>9.2}\n", m.cosine(), m.sqnr_db()));
    }
    text
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn gates_are_keys_with_limits() {
        assert_eq!(parse_gate("render_psnr=45").unwrap()[0].key, "render_psnr_db");
        assert_eq!(parse_gate("depth_absrel=0.01").unwrap(), [Gate { key: "depth_absrel".into(), limit: 0.01 }]);
        assert_eq!(parse_gate("int8").unwrap().len(), INT8_GATES.len());
        for bad in
            ["", "depth_absrel", "depth=1", "depth_absrel=x", "depth_absrel=nan", "depth_absrel=0", "render_psnr_db=-1"]
        {
            assert!(parse_gate(bad).is_err(), "{bad}");
        }
    }
}
