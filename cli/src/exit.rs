//! The process's end: one line on standard error and the exit code of the status.
//!
//! | code | meaning |
//! |---:|---|
//! | 0 | done |
//! | 1 | a check failed |
//! | 2 | wrong arguments |
//! | 3 | clip, image, camera, time or scene rejected |
//! | 4 | blob or checkpoint rejected |
//! | 5 | memory or another budget |
//! | 6 | reading or writing failed |
//! | 7 | understood, not supported here |
//! | 9 | digest, self-test or a file that changed |
//! | 70 | a bug of ours |
//! | 130 | Ctrl-C |

use clap::error::{ContextKind, ErrorKind};
use sf_formats::error::one_line;
use sf_formats::{Error, Result};
use std::panic::{self, AssertUnwindSafe};
use std::process::ExitCode;
use std::sync::Mutex;

/// Where a panic happened and what it said: the hook stores it, [`guarded`] reports it.
static PANIC: Mutex<Option<String>> = Mutex::new(None);

/// Runs the command; a panic becomes [`Error::Internal`] instead of a backtrace.
pub(crate) fn guarded(command: impl FnOnce() -> Result<()>) -> Result<()> {
    panic::set_hook(Box::new(|info| {
        let payload = info.payload();
        let what = payload.downcast_ref::<&str>().copied();
        let what = what.or_else(|| payload.downcast_ref::<String>().map(String::as_str)).unwrap_or("no message");
        let at = info.location().map_or_else(|| "?".to_string(), ToString::to_string);
        let mut slot = PANIC.lock().unwrap_or_else(std::sync::PoisonError::into_inner);
        // The first panic is the cause; those that follow in other threads are echoes.
        slot.get_or_insert_with(|| format!("{what} at {at}; please report this with the command line"));
    }));
    panic::catch_unwind(AssertUnwindSafe(command)).unwrap_or_else(|_| {
        let mut slot = PANIC.lock().unwrap_or_else(std::sync::PoisonError::into_inner);
        Err(Error::Internal(slot.take().unwrap_or_else(|| "panic without a message".into())))
    })
}

/// Prints the error, if any, and gives the exit code.
pub(crate) fn code(result: &Result<()>) -> ExitCode {
    match result {
        Ok(()) => ExitCode::SUCCESS,
        Err(e) => {
            use std::io::Write;
            // A closed standard error must not hide the exit code.
            let _ = writeln!(std::io::stderr(), "{}", error_line(e));
            ExitCode::from(e.status() as u8)
        }
    }
}

/// `error: ` and the message, one line, at most 300 bytes.
fn error_line(e: &Error) -> String {
    one_line(&format!("error: {e}"))
}

/// What the argument parser answered instead of arguments.
pub(crate) enum Parsed {
    /// Help or version: goes to standard output, success.
    Text(String),
    /// Wrong arguments.
    Wrong(Error),
}

/// The parser's answer as text to print or as a one-line usage error.
pub(crate) fn parsed(e: &clap::Error) -> Parsed {
    match e.kind() {
        ErrorKind::DisplayHelp | ErrorKind::DisplayVersion => Parsed::Text(e.render().to_string()),
        ErrorKind::DisplayHelpOnMissingArgumentOrSubcommand | ErrorKind::MissingSubcommand => {
            Parsed::Wrong(Error::usage("no command given; try 'streetforward --help'"))
        }
        _ => {
            let text = e.render().to_string();
            // The parser's report is the message, hints and usage, each a paragraph: the first
            // paragraph is what happened.
            let what = text.split("\n\n").next().unwrap_or_default();
            let what: Vec<&str> = what.split_whitespace().skip_while(|w| *w == "error:").collect();
            let mut what = what.join(" ");
            if let Some(clap::error::ContextValue::String(s)) =
                e.get(ContextKind::SuggestedArg).or_else(|| e.get(ContextKind::SuggestedSubcommand))
            {
                what.push_str(&format!("; did you mean '{s}'?"));
            }
            if let Some(clap::error::ContextValue::Strings(s)) =
                e.get(ContextKind::SuggestedSubcommand).or_else(|| e.get(ContextKind::SuggestedValue))
                && let Some(first) = s.first()
            {
                what.push_str(&format!("; did you mean '{first}'?"));
            }
            Parsed::Wrong(Error::usage(format!("{what}; try --help")))
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_panic_becomes_an_internal_error_of_one_line() {
        let e = guarded(|| panic!("index {}\nout of range", 7)).unwrap_err();
        let _ = panic::take_hook();
        assert_eq!(e.status() as i32, 70);
        let line = error_line(&e);
        assert!(line.starts_with("error: internal error: index 7 out of range at "), "{line}");
        assert!(line.contains("exit.rs:"), "{line}");
        assert!(!line.contains('\n'));
    }

    #[test]
    fn an_error_line_is_at_most_300_bytes_with_its_prefix() {
        let line = error_line(&Error::input("é".repeat(200), "x"));
        assert!(line.len() <= 300 && line.ends_with("..."));
    }
}
