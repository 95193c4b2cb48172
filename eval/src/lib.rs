//! How good a reconstruction is: metrics, and the 20-frame protocol.
//!
//! | file | what |
//! |---|---|
//! | `metrics.rs` | PSNR, depth, velocity, masks, poses: plain functions of arrays |
//! | `ssim.rs` | structural similarity as scikit-image's default |
//! | `align.rs` | the similarity transform between two sets of poses |
//! | `protocol.rs` | [`Protocol`]: which frames are context, which are tested, with which cameras |
//! | `oracle_scene.rs` | [`oracle_scene()`]: the scene of a perfect network, from ground truth |
//! | `evaluate.rs` | [`evaluate()`]: the measurement of a scene on them; [`measure`]: of one more |
//! | `compare.rs` | [`Comparison`]: one model's predictions against another's; gates |
//! | `report.rs` | [`EvalReport`]: means per method and part, as JSON and as a Markdown table |
#![deny(unsafe_code)]

pub mod align;
pub mod compare;
pub mod evaluate;
pub mod metrics;
pub mod oracle_scene;
pub mod protocol;
pub mod report;
pub mod ssim;

pub use compare::{Comparison, Gate, INT8_GATES, Side, StageMatch};
pub use evaluate::{Subject, evaluate, evaluate_subject, measure, standing};
pub use oracle_scene::{OracleFrame, OracleOptions, oracle_of_clip, oracle_scene};
pub use protocol::{EvalClip, EvalFrame, EvalOptions, Protocol, TargetPoses};
pub use report::{EvalReport, Method, Metric, Part, Scores};
