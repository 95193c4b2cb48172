//! Progress bars on standard error: only on a terminal, silent when piped, quiet or JSON is asked.

use indicatif::{ProgressBar, ProgressDrawTarget, ProgressStyle};

/// A bar over a known number of steps; vanishes when dropped.
pub(crate) struct Progress(ProgressBar);

impl Progress {
    /// A bar of `total` steps of `what`; shown only when `visible` (and standard error is a terminal).
    pub(crate) fn new(total: u64, what: &'static str, visible: bool) -> Progress {
        // The stderr target draws nothing when standard error is not a terminal.
        let target = if visible { ProgressDrawTarget::stderr() } else { ProgressDrawTarget::hidden() };
        let bar = ProgressBar::with_draw_target(Some(total), target);
        let style = ProgressStyle::with_template("{msg:10} [{bar:32}] {pos}/{len} {eta}")
            .expect("the template is a constant")
            .progress_chars("=> ");
        bar.set_style(style);
        bar.set_message(what);
        Progress(bar)
    }

    /// One step done.
    pub(crate) fn step(&self) {
        self.0.inc(1);
    }
}

impl Drop for Progress {
    fn drop(&mut self) {
        self.0.finish_and_clear();
    }
}
