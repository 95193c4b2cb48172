//! [`EvalReport`]: means of every metric for every method and part, as JSON and as a Markdown table.

use std::fmt::Write;

use serde_json::{Map, Value, json};
use sf_formats::{Error, Result};

/// What made the pictures.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Method {
    /// The reconstruction with its motion.
    Model,
    /// The same scene with every velocity zero: what motion is worth.
    NoMotion,
    /// The same scene where dynamic Gaussians come from the context frame before alone, moved by v+.
    ForwardOnly,
    /// The network without attention to other frames in its causal module.
    NoCausal,
    /// The context frame nearest in time (the earlier of two), copied.
    CopyNearest,
    /// True depth, poses, velocity and mask through the same renderer, one round Gaussian per pixel.
    Oracle,
    /// The same with every velocity zero.
    OracleNoMotion,
}

impl Method {
    /// All, in order.
    pub const ALL: [Method; 7] = [
        Method::Model,
        Method::NoMotion,
        Method::ForwardOnly,
        Method::NoCausal,
        Method::CopyNearest,
        Method::Oracle,
        Method::OracleNoMotion,
    ];

    /// Key in reports.
    pub fn key(self) -> &'static str {
        match self {
            Method::Model => "model",
            Method::NoMotion => "no_motion",
            Method::ForwardOnly => "forward_only",
            Method::NoCausal => "no_causal",
            Method::CopyNearest => "copy_nearest",
            Method::Oracle => "oracle",
            Method::OracleNoMotion => "oracle_no_motion",
        }
    }

    /// Key of the group it stands in, within a report; the model has none.
    fn group(self) -> Option<&'static str> {
        match self {
            Method::Model => None,
            Method::NoMotion | Method::ForwardOnly | Method::NoCausal => Some("ablations"),
            Method::CopyNearest => Some("baselines"),
            Method::Oracle | Method::OracleNoMotion => Some("bounds"),
        }
    }
}

/// Which frames a mean is over.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Part {
    /// All test frames; and the context frames for what is measured there.
    All,
    /// Test frames between the first and the last context frame.
    Interpolation,
    /// Test frames after the last context frame.
    Extrapolation,
}

impl Part {
    /// All, in order.
    pub const ALL: [Part; 3] = [Part::All, Part::Interpolation, Part::Extrapolation];

    /// Key in reports.
    pub fn key(self) -> &'static str {
        match self {
            Part::All => "all",
            Part::Interpolation => "interpolation",
            Part::Extrapolation => "extrapolation",
        }
    }
}

/// What is measured. Picture and depth metrics are taken per test frame and averaged over frames;
/// velocity, mask and pose metrics are taken at the context frames.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Metric {
    /// PSNR of the whole picture, dB.
    PsnrFull,
    /// SSIM of the whole picture.
    SsimFull,
    /// PSNR over dynamic pixels, dB.
    PsnrDynamic,
    /// Mean of the SSIM map over dynamic pixels.
    SsimDynamic,
    /// Depth RMSE over valid pixels, scene units.
    DepthRmseFull,
    /// Depth RMSE over valid static pixels.
    DepthRmseStatic,
    /// Depth RMSE over valid dynamic pixels.
    DepthRmseDynamic,
    /// [`Metric::DepthRmseFull`] after scaling every frame by the ratio of medians.
    DepthRmseFullScaled,
    /// [`Metric::DepthRmseStatic`] with that scale.
    DepthRmseStaticScaled,
    /// [`Metric::DepthRmseDynamic`] with that scale.
    DepthRmseDynamicScaled,
    /// Mean |error| / depth over valid pixels.
    DepthAbsRel,
    /// The same with the median scale.
    DepthAbsRelScaled,
    /// Share of valid pixels within a factor of 1.25.
    DepthDelta1,
    /// The same with the median scale.
    DepthDelta1Scaled,
    /// Velocity end-point error over dynamic pixels, scene units per second; worlds rotated onto each other.
    VelocityEpe,
    /// The same with the predicted velocity in the unit of the true poses.
    VelocityEpeScaled,
    /// Mean true speed over dynamic pixels: the end-point error of predicting no motion.
    VelocitySpeed,
    /// [`Metric::VelocityEpe`] over crossing traffic: true velocity across the camera's view rather than along it.
    VelocityEpeCrossing,
    /// [`Metric::VelocitySpeed`] over the same pixels.
    VelocitySpeedCrossing,
    /// Mean predicted speed over static pixels: false motion.
    StaticSpeed,
    /// Intersection over union of the dynamic masks, pixels of all frames together.
    DynamicIou,
    /// Intersection over union of the sky masks, pixels of all frames together.
    SkyIou,
    /// Mean |error| / depth of the network's own depth at the context frames.
    ContextDepthAbsRel,
    /// The same with the median scale.
    ContextDepthAbsRelScaled,
    /// Its RMSE, scene units.
    ContextDepthRmse,
    /// Rotation error of context cameras relative to the first, degrees.
    RotationDeg,
    /// True rotation relative to the first, degrees: the error of predicting none.
    RotationIdentityDeg,
    /// Direction error of the way from the first context camera, degrees.
    TranslationDirectionDeg,
    /// Error of that way, scene units.
    TranslationError,
    /// True length of that way: the error of predicting none.
    Travel,
    /// Error of context camera centres after similarity alignment, true units.
    TranslationErrorScaled,
}

impl Metric {
    /// All with their keys, in order.
    pub const ALL: [(Metric, &'static str); 31] = [
        (Metric::PsnrFull, "psnr_full_db"),
        (Metric::SsimFull, "ssim_full"),
        (Metric::PsnrDynamic, "psnr_dynamic_db"),
        (Metric::SsimDynamic, "ssim_dynamic"),
        (Metric::DepthRmseFull, "depth_rmse_full"),
        (Metric::DepthRmseStatic, "depth_rmse_static"),
        (Metric::DepthRmseDynamic, "depth_rmse_dynamic"),
        (Metric::DepthRmseFullScaled, "depth_rmse_full_scaled"),
        (Metric::DepthRmseStaticScaled, "depth_rmse_static_scaled"),
        (Metric::DepthRmseDynamicScaled, "depth_rmse_dynamic_scaled"),
        (Metric::DepthAbsRel, "depth_absrel"),
        (Metric::DepthAbsRelScaled, "depth_absrel_scaled"),
        (Metric::DepthDelta1, "depth_delta1"),
        (Metric::DepthDelta1Scaled, "depth_delta1_scaled"),
        (Metric::VelocityEpe, "velocity_epe"),
        (Metric::VelocityEpeScaled, "velocity_epe_scaled"),
        (Metric::VelocitySpeed, "velocity_speed"),
        (Metric::VelocityEpeCrossing, "velocity_epe_crossing"),
        (Metric::VelocitySpeedCrossing, "velocity_speed_crossing"),
        (Metric::StaticSpeed, "static_speed"),
        (Metric::DynamicIou, "dynamic_iou"),
        (Metric::SkyIou, "sky_iou"),
        (Metric::ContextDepthAbsRel, "context_depth_absrel"),
        (Metric::ContextDepthAbsRelScaled, "context_depth_absrel_scaled"),
        (Metric::ContextDepthRmse, "context_depth_rmse"),
        (Metric::RotationDeg, "rotation_deg"),
        (Metric::RotationIdentityDeg, "rotation_identity_deg"),
        (Metric::TranslationDirectionDeg, "translation_direction_deg"),
        (Metric::TranslationError, "translation_error"),
        (Metric::Travel, "travel"),
        (Metric::TranslationErrorScaled, "translation_error_scaled"),
    ];

    /// Means over the mean of predicting nothing: keys, numerators, denominators.
    pub const RATIOS: [(&'static str, Metric, Metric); 4] = [
        ("velocity_epe_ratio", Metric::VelocityEpe, Metric::VelocitySpeed),
        ("velocity_epe_crossing_ratio", Metric::VelocityEpeCrossing, Metric::VelocitySpeedCrossing),
        ("rotation_ratio", Metric::RotationDeg, Metric::RotationIdentityDeg),
        ("translation_error_ratio", Metric::TranslationError, Metric::Travel),
    ];
}

/// A weighted mean that is still being taken.
#[derive(Clone, Copy, Debug, Default, PartialEq)]
struct Mean {
    sum: f64,
    weight: f64,
}

/// Means of all metrics.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct Scores([Mean; Metric::ALL.len()]);

impl Scores {
    /// Counts one value; `None` counts nothing.
    pub fn add(&mut self, metric: Metric, value: Option<f64>) {
        if let Some(value) = value {
            self.add_sum(metric, value, 1.0);
        }
    }

    /// Counts a sum of values and their number (or weight).
    pub fn add_sum(&mut self, metric: Metric, sum: f64, weight: f64) {
        let mean = &mut self.0[metric as usize];
        mean.sum += sum;
        mean.weight += weight;
    }

    /// The mean; `None` when nothing was counted.
    pub fn get(&self, metric: Metric) -> Option<f64> {
        let mean = self.0[metric as usize];
        (mean.weight > 0.0).then(|| mean.sum / mean.weight)
    }

    /// The ratio of two means; `None` when one was not counted or the second is zero.
    pub fn ratio(&self, over: Metric, under: Metric) -> Option<f64> {
        let (over, under) = (self.get(over)?, self.get(under)?);
        (under > 0.0).then(|| over / under)
    }

    /// Whether anything was counted.
    pub fn any(&self) -> bool {
        self.0.iter().any(|m| m.weight > 0.0)
    }

    /// Counts what another has counted.
    pub fn merge(&mut self, other: &Scores) {
        for (a, b) in self.0.iter_mut().zip(&other.0) {
            a.sum += b.sum;
            a.weight += b.weight;
        }
    }

    /// All keys; `null` where nothing was counted.
    fn json(&self) -> Map<String, Value> {
        let means = Metric::ALL.iter().map(|(m, key)| (key.to_string(), json!(self.get(*m))));
        let ratios =
            Metric::RATIOS.iter().map(|(key, over, under)| (key.to_string(), json!(self.ratio(*over, *under))));
        means.chain(ratios).collect()
    }
}

/// The result of one clip, or of many.
#[derive(Clone, Debug, PartialEq)]
pub struct EvalReport {
    /// Name of the protocol.
    pub protocol: &'static str,
    /// Where the test cameras came from.
    pub target_poses: &'static str,
    /// Clips counted.
    pub clips: usize,
    /// Context frames counted.
    pub context_frames: usize,
    /// Test frames between context frames.
    pub interpolation_frames: usize,
    /// Test frames after the last context frame.
    pub extrapolation_frames: usize,
    scores: [[Scores; Part::ALL.len()]; Method::ALL.len()],
}

impl EvalReport {
    /// A report of nothing.
    pub fn empty(protocol: &'static str, target_poses: &'static str) -> EvalReport {
        EvalReport {
            protocol,
            target_poses,
            clips: 0,
            context_frames: 0,
            interpolation_frames: 0,
            extrapolation_frames: 0,
            scores: Default::default(),
        }
    }

    /// Means of a method over a part.
    pub fn scores(&self, method: Method, part: Part) -> &Scores {
        &self.scores[method as usize][part as usize]
    }

    /// The same, to count in.
    pub fn scores_mut(&mut self, method: Method, part: Part) -> &mut Scores {
        &mut self.scores[method as usize][part as usize]
    }

    /// One mean of the model over all test frames.
    pub fn get(&self, metric: Metric) -> Option<f64> {
        self.scores(Method::Model, Part::All).get(metric)
    }

    /// Counts the frames of another report too.
    pub fn merge(&mut self, other: &EvalReport) -> Result<()> {
        if (self.protocol, self.target_poses) != (other.protocol, other.target_poses) {
            return Err(Error::usage(format!(
                "reports of different protocols cannot be merged: {} with {} poses, {} with {} poses",
                self.protocol, self.target_poses, other.protocol, other.target_poses
            )));
        }
        self.clips += other.clips;
        self.context_frames += other.context_frames;
        self.interpolation_frames += other.interpolation_frames;
        self.extrapolation_frames += other.extrapolation_frames;
        for (a, b) in self.scores.iter_mut().flatten().zip(other.scores.iter().flatten()) {
            a.merge(b);
        }
        Ok(())
    }

    fn method_json(&self, method: Method) -> Map<String, Value> {
        let mut map = self.scores(method, Part::All).json();
        for part in [Part::Interpolation, Part::Extrapolation] {
            map.insert(part.key().into(), self.scores(method, part).json().into());
        }
        map
    }

    /// Methods that were measured, in order.
    pub fn methods(&self) -> impl Iterator<Item = Method> {
        Method::ALL.into_iter().filter(|&m| self.scores(m, Part::All).any())
    }

    /// The report as JSON. The model's means are keys of the object itself; `interpolation`, `extrapolation`,
    /// and every other method under `ablations`, `baselines` or `bounds` repeat them.
    pub fn to_json(&self) -> Value {
        let mut map = Map::new();
        map.insert("schema".into(), "streetforward.eval/1".into());
        map.insert("protocol".into(), self.protocol.into());
        map.insert("target_poses".into(), self.target_poses.into());
        map.insert("clips".into(), self.clips.into());
        map.insert("context_frames".into(), self.context_frames.into());
        map.insert("interpolation_frames".into(), self.interpolation_frames.into());
        map.insert("extrapolation_frames".into(), self.extrapolation_frames.into());
        map.extend(self.method_json(Method::Model));
        for group in ["ablations", "baselines", "bounds"] {
            map.insert(group.into(), Map::new().into());
        }
        for method in self.methods() {
            if let Some(group) = method.group() {
                map[group][method.key()] = self.method_json(method).into();
            }
        }
        map.into()
    }

    /// The report as Markdown: a table of methods by part, and what is measured at the context frames. Columns
    /// are aligned, so that it reads as plain text too.
    pub fn to_markdown(&self) -> String {
        const COLUMNS: [(Metric, &str, usize); 9] = [
            (Metric::PsnrFull, "PSNR dB", 2),
            (Metric::SsimFull, "SSIM", 3),
            (Metric::PsnrDynamic, "dyn. PSNR dB", 2),
            (Metric::SsimDynamic, "dyn. SSIM", 3),
            (Metric::DepthAbsRel, "depth abs-rel", 3),
            (Metric::DepthAbsRelScaled, "scaled", 3),
            (Metric::DepthRmseFull, "depth RMSE", 2),
            (Metric::DepthRmseStatic, "static", 2),
            (Metric::DepthRmseDynamic, "dynamic", 2),
        ];
        let mut out = format!(
            "Protocol {}, target poses {}: {} clips, {} context, {} interpolated and {} extrapolated frames.\n\n",
            self.protocol,
            self.target_poses,
            self.clips,
            self.context_frames,
            self.interpolation_frames,
            self.extrapolation_frames
        );
        let text = |s: &str| s.to_string();
        let mut rows = vec![["frames", "method"].into_iter().chain(COLUMNS.map(|c| c.1)).map(text).collect()];
        for part in Part::ALL {
            for method in self.methods() {
                let scores = self.scores(method, part);
                let cells = COLUMNS.iter().map(|(m, _, digits)| cell(scores.get(*m), *digits));
                rows.push([part.key(), method.key()].into_iter().map(text).chain(cells).collect());
            }
        }
        out.push_str(&table(&rows, 2));
        out.push('\n');
        // Only what predicts something of its own has numbers at the context frames.
        let own = [Method::Model, Method::NoCausal];
        let own: Vec<Method> = self.methods().filter(|m| own.contains(m)).collect();
        let mut rows =
            vec![["at the context frames"].into_iter().chain(own.iter().map(|m| m.key())).map(text).collect()];
        let first = Metric::VelocityEpe as usize;
        let value = |metric: Metric| move |s: &Scores| s.get(metric);
        let mut row = |key: &str, get: &dyn Fn(&Scores) -> Option<f64>| {
            let cells = own.iter().map(|m| cell(get(self.scores(*m, Part::All)), 3));
            rows.push([text(key)].into_iter().chain(cells).collect::<Vec<_>>());
        };
        for (metric, key) in &Metric::ALL[first..] {
            row(key, &value(*metric));
        }
        for (key, over, under) in Metric::RATIOS {
            row(key, &|s: &Scores| s.ratio(over, under));
        }
        out.push_str(&table(&rows, 1));
        out
    }
}

/// Rows as a Markdown table of aligned columns; the first row is the head, the first `left` columns are text.
fn table(rows: &[Vec<String>], left: usize) -> String {
    let width = |c: usize| rows.iter().map(|r| r[c].chars().count()).max().unwrap_or(0).max(4);
    let mut out = String::new();
    for (i, row) in rows.iter().enumerate() {
        let cells: Vec<String> = row
            .iter()
            .enumerate()
            .map(|(c, v)| if c < left { format!("{v:<w$}", w = width(c)) } else { format!("{v:>w$}", w = width(c)) })
            .collect();
        let _ = writeln!(out, "| {} |", cells.join(" | "));
        if i == 0 {
            let rule = |c: usize| if c < left { "-".repeat(width(c)) } else { "-".repeat(width(c) - 1) + ":" };
            let _ = writeln!(out, "| {} |", (0..row.len()).map(rule).collect::<Vec<_>>().join(" | "));
        }
    }
    out
}

fn cell(value: Option<f64>, digits: usize) -> String {
    value.map_or("-".into(), |v| format!("{v:.digits$}"))
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn metrics_are_listed_in_their_own_order() {
        for (i, (metric, _)) in Metric::ALL.iter().enumerate() {
            assert_eq!(*metric as usize, i);
        }
        assert!(Method::ALL.iter().enumerate().all(|(i, m)| *m as usize == i));
        assert!(Part::ALL.iter().enumerate().all(|(i, p)| *p as usize == i));
    }

    #[test]
    fn ratios_are_over_predicting_nothing() {
        let mut scores = Scores::default();
        assert!(!scores.any() && scores.ratio(Metric::TranslationError, Metric::Travel).is_none());
        scores.add_sum(Metric::TranslationError, 3.0, 2.0);
        scores.add_sum(Metric::Travel, 24.0, 2.0);
        assert_eq!(scores.ratio(Metric::TranslationError, Metric::Travel), Some(0.125));
        assert_eq!(scores.json()["translation_error_ratio"], 0.125);
        scores.add(Metric::VelocityEpe, Some(1.0));
        scores.add(Metric::VelocitySpeed, Some(0.0));
        assert_eq!(scores.ratio(Metric::VelocityEpe, Metric::VelocitySpeed), None);
    }

    #[test]
    fn merged_means_are_over_all_frames() {
        let one = |values: &[f64]| {
            let mut r = EvalReport::empty("p", "predicted");
            (r.clips, r.interpolation_frames) = (1, values.len());
            for v in values {
                r.scores_mut(Method::Model, Part::All).add(Metric::PsnrFull, Some(*v));
            }
            r.scores_mut(Method::Model, Part::All).add(Metric::SsimFull, None);
            r
        };
        let mut sum = one(&[20.0]);
        sum.merge(&one(&[30.0, 40.0])).unwrap();
        assert_eq!((sum.clips, sum.interpolation_frames, sum.get(Metric::PsnrFull)), (2, 3, Some(30.0)));
        let json = sum.to_json();
        assert_eq!(json["psnr_full_db"], 30.0);
        assert!(json["ssim_full"].is_null() && json["baselines"]["copy_nearest"].is_null());
        assert!(json["interpolation"].get("depth_rmse_static").is_some());
        let text = sum.to_markdown();
        assert!(text.contains("| all           | model  |   30.00 |    - |"), "{text}");
        // Every row of a table is as long as its head.
        let rows: Vec<&str> = text.lines().filter(|l| l.starts_with("| all") || l.starts_with("| frames")).collect();
        assert!(rows.len() == 2 && rows[0].len() == rows[1].len(), "{text}");
        assert!(sum.merge(&EvalReport::empty("p", "truth")).is_err());
    }
}
