//! What the process does about signals. The libraries install none; only this binary does.
//!
//! - Ctrl-C and SIGTERM: temporary files and folders of this process are removed, one line, exit
//!   130 (143). A thread waits for them with `sigwait`, so the clean-up is ordinary code and not an
//!   asynchronous handler.
//! - SIGBUS (a mapped weight blob was cut off while in use): one line, exit 9.
//! - SIGXFSZ is ignored, so a file-size limit becomes a write error that names the file.
//! - A standard output that is closed at start is remembered, so that results lost that way fail.
#![allow(unsafe_code)]

use std::path::{Path, PathBuf};
use std::sync::Mutex;
use std::sync::atomic::{AtomicBool, Ordering};

/// Temporary folders to delete whole, and folders in which this process may have temporary files.
#[derive(Default)]
struct Litter {
    stages: Vec<PathBuf>,
    folders: Vec<PathBuf>,
}

static LITTER: Mutex<Litter> = Mutex::new(Litter { stages: Vec::new(), folders: Vec::new() });

fn litter() -> std::sync::MutexGuard<'static, Litter> {
    LITTER.lock().unwrap_or_else(std::sync::PoisonError::into_inner)
}

/// From now on an interrupt deletes this temporary folder.
pub(crate) fn guard_stage(folder: &Path) {
    litter().stages.push(folder.to_path_buf());
}

/// The temporary folder is gone or has become the result.
pub(crate) fn release_stage(folder: &Path) {
    litter().stages.retain(|f| f != folder);
}

/// From now on an interrupt deletes this process's temporary files beside `file`.
pub(crate) fn guard_file(file: &Path) {
    let folder = match file.parent() {
        Some(p) if !p.as_os_str().is_empty() => p,
        _ => Path::new("."),
    };
    litter().folders.push(folder.to_path_buf());
}

/// Removes what an interrupted command leaves: see [`guard_stage`] and [`guard_file`].
fn sweep() {
    let litter = litter();
    for stage in &litter.stages {
        // Busy threads still create files and subfolders: under another name the folder is out of their reach,
        // and what they make anew at the old one is removed until it stays away.
        let mut gone = stage.clone().into_os_string();
        gone.push(".gone");
        let gone = Path::new(&gone);
        let mut quiet = 0;
        for _ in 0..2000 {
            let _ = std::fs::rename(stage, gone);
            let _ = std::fs::remove_dir_all(gone);
            quiet = if stage.exists() || gone.exists() { 0 } else { quiet + 1 };
            if quiet == 100 {
                break;
            }
            std::thread::sleep(std::time::Duration::from_millis(1));
        }
    }
    // The names that `sf_formats::atomic` gives: `.NAME.PID.tmp`.
    let suffix = format!(".{}.tmp", std::process::id());
    for folder in &litter.folders {
        for entry in std::fs::read_dir(folder).into_iter().flatten().flatten() {
            let name = entry.file_name();
            let name = name.as_encoded_bytes();
            if name.starts_with(b".") && name.ends_with(suffix.as_bytes()) {
                let _ = std::fs::remove_file(entry.path());
            }
        }
    }
}

static INTERRUPTED: AtomicBool = AtomicBool::new(false);

/// Once interrupted, the thread that cleans up ends the process: whoever fails meanwhile waits for it.
pub(crate) fn wait_if_interrupted() {
    while INTERRUPTED.load(Ordering::Relaxed) {
        std::thread::park();
    }
}

static STDOUT_CLOSED: AtomicBool = AtomicBool::new(false);

/// Runs before Rust's start-up code, which replaces a closed standard output by `/dev/null` and
/// so hides that results are lost.
extern "C" fn probe_stdout() {
    // SAFETY: fcntl with F_GETFD only reads the descriptor's flags.
    let flags = unsafe { libc::fcntl(libc::STDOUT_FILENO, libc::F_GETFD) };
    STDOUT_CLOSED.store(flags == -1, Ordering::Relaxed);
}

#[cfg(target_os = "linux")]
#[used]
// SAFETY: an ELF constructor entry: a function pointer of C type that touches one atomic and
// makes one system call, neither of which needs Rust's runtime.
#[unsafe(link_section = ".init_array")]
static PROBE: extern "C" fn() = probe_stdout;

/// Whether standard output was closed when the process started.
pub(crate) fn stdout_closed() -> bool {
    STDOUT_CLOSED.load(Ordering::Relaxed)
}

extern "C" fn on_bus_error(_: libc::c_int) {
    const LINE: &[u8] = b"error: a mapped file was cut off while in use; use --load copy on such file systems\n";
    // SAFETY: write and _exit are async-signal-safe, and the buffer is a constant.
    unsafe {
        libc::write(libc::STDERR_FILENO, LINE.as_ptr().cast(), LINE.len());
        libc::_exit(9);
    }
}

/// Sets the process up; call once, first.
pub(crate) fn install() {
    // SAFETY: called once from main before any other thread exists; the sets and actions are
    // initialised by the calls that take them, and the handler is async-signal-safe.
    let waited = unsafe {
        libc::signal(libc::SIGXFSZ, libc::SIG_IGN);
        let handler: extern "C" fn(libc::c_int) = on_bus_error;
        libc::signal(libc::SIGBUS, handler as libc::sighandler_t);
        let mut set: libc::sigset_t = std::mem::zeroed();
        libc::sigemptyset(&mut set);
        for signal in [libc::SIGINT, libc::SIGTERM] {
            // A background job of a script, or one under nohup, ignores it: so do we.
            let mut old: libc::sigaction = std::mem::zeroed();
            if libc::sigaction(signal, std::ptr::null(), &mut old) == 0 && old.sa_sigaction != libc::SIG_IGN {
                libc::sigaddset(&mut set, signal);
            }
        }
        libc::pthread_sigmask(libc::SIG_BLOCK, &set, std::ptr::null_mut());
        set
    };
    // Without the thread the signals would stay blocked: then they keep their default effect.
    let spawned = std::thread::Builder::new().name("signals".into()).stack_size(64 << 10).spawn(move || {
        let mut signal = 0;
        // SAFETY: the set is initialised above and the signals in it are blocked.
        if unsafe { libc::sigwait(&waited, &mut signal) } == 0 {
            INTERRUPTED.store(true, Ordering::Relaxed);
            sweep();
            eprintln!("error: interrupted; temporary files are removed");
            // SAFETY: ends the process without running the destructors of busy threads.
            unsafe { libc::_exit(128 + signal) };
        }
    });
    if spawned.is_err() {
        // SAFETY: as above.
        unsafe { libc::pthread_sigmask(libc::SIG_UNBLOCK, &waited, std::ptr::null_mut()) };
    }
}
