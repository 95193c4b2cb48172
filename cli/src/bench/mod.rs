//! What `bench` is made of.
//!
//! | file | what |
//! |---|---|
//! | `stats.rs` | percentiles that say when they have too few samples, the interval of the median |
//! | `measure.rs` | first run, warm-up, runs that count; back to back or at a camera's pace; operations by kind |
//! | `row.rs` | one configuration's figures as JSON, Markdown and CSV |
//! | `baseline.rs` | the comparison with an earlier report |

pub(crate) mod baseline;
pub(crate) mod measure;
pub(crate) mod row;
pub(crate) mod stats;
