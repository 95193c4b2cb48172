//! Progress bars on standard error: only on a terminal, silent when piped, quiet or JSON is asked.

use indicatif::{ProgressBar, ProgressDrawTarget, ProgressStyle};
use std::sync::Arc;
use std::sync::atomic::{AtomicU32, Ordering};
use std::sync::mpsc::{RecvTimeoutError, channel};
use std::thread::{JoinHandle, spawn};
use std::time::Duration;

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

    /// So many steps done.
    pub(crate) fn set(&self, done: u64) {
        self.0.set_position(done);
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

/// A bar that follows a counter which somebody else raises; vanishes when dropped.
pub(crate) struct Follow {
    // Dropping the sender ends the thread at once.
    stop: Option<std::sync::mpsc::Sender<()>>,
    thread: Option<JoinHandle<()>>,
}

impl Follow {
    /// Draws `done` of `total` steps of `what` until dropped; without `visible` nothing is started.
    pub(crate) fn new(done: Arc<AtomicU32>, total: u32, what: &'static str, visible: bool) -> Follow {
        if !visible {
            return Follow { stop: None, thread: None };
        }
        let (stop, stopped) = channel::<()>();
        let thread = spawn(move || {
            let bar = Progress::new(u64::from(total), what, true);
            while stopped.recv_timeout(Duration::from_millis(100)) == Err(RecvTimeoutError::Timeout) {
                bar.0.set_position(u64::from(done.load(Ordering::Relaxed)));
            }
        });
        Follow { stop: Some(stop), thread: Some(thread) }
    }
}

impl Drop for Follow {
    fn drop(&mut self) {
        self.stop = None;
        if let Some(thread) = self.thread.take() {
            // A drawing thread that panicked has nothing to lose.
            let _ = thread.join();
        }
    }
}
