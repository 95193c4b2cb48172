//! The `streetforward` command: thin verbs over the crates beside it.
//!
//! | file | what |
//! |---|---|
//! | `args.rs` | flag groups and value parsers that verbs share |
//! | `output.rs` | results, remarks, numbers for people |
//! | `folder.rs` | output folders that appear whole |
//! | `progress.rs` | progress bars, on a terminal only |
//! | `exit.rs` | one-line errors, exit codes, caught panics |
//! | `network.rs` | presets, configuration files, checkpoints with a progress bar |
//! | `model.rs` | the model of a verb: blob, checkpoint, or random weights |
//! | `reconstruct.rs` | clip and model to network output |
//! | `results.rs` | network output to files |
//! | `golden.rs` | the golden run of a blob |
//! | `scan.rs` | which layers int8 is too coarse for |
//! | `versus.rs` | one model against another: `compare` and the checks of `convert` |
//! | `overview.rs` | one sheet of a run's pictures with scales |
//! | `views.rs` | cameras for `render`: along the clip, behind it, fixed, in orbit, displaced, following a thing |
//! | `reals.rs` | the pictures that a scene was made from |
//! | `video.rs` | animated PNG, y4m, mp4 |
//! | `html.rs`, `assets/viewer/` | a scene as one page for a browser |
//! | `report.rs` | results as tables and charts on one page |
//! | `growth.rs` | how cost grows with the clip, as a chart |
//! | `machine.rs` | processor, memory, load, clock, measured peaks |
//! | `bench/` | what `bench` is made of |
//! | `signals.rs` | Ctrl-C, file-size limits, truncated mappings |
//! | `verbs/` | one file per verb |
#![deny(unsafe_code)]

mod args;
mod bench;
mod exit;
mod folder;
mod golden;
mod growth;
mod html;
mod machine;
mod model;
mod network;
mod output;
mod overview;
mod progress;
mod reals;
mod reconstruct;
mod report;
mod results;
mod scan;
mod signals;
mod verbs;
mod versus;
mod video;
mod views;

use clap::Parser;
use output::Console;
use std::process::ExitCode;

/// A clip of street images in, a moving 3D street out, on plain CPU cores.
///
/// Results go to standard output, progress and remarks to standard error. Exit codes: 0 done,
/// 1 a check failed, 2 usage, 3 input, 4 model, 5 resources, 6 reading or writing, 7 unsupported,
/// 9 integrity, 70 internal, 130 interrupted.
#[derive(Parser)]
#[command(name = "streetforward", version, max_term_width = 100)]
struct Cli {
    #[command(subcommand)]
    verb: verbs::Verb,
    /// Report as one JSON document
    #[arg(long, global = true, help_heading = "Report")]
    json: bool,
    /// No remarks and no progress on standard error
    #[arg(short, long, global = true, help_heading = "Report")]
    quiet: bool,
}

fn main() -> ExitCode {
    signals::install();
    let result = exit::guarded(|| match Cli::try_parse() {
        Ok(cli) => cli.verb.run(&Console::new(cli.json, cli.quiet)),
        Err(e) => match exit::parsed(&e) {
            exit::Parsed::Text(text) => output::write_stdout(text.as_bytes()),
            exit::Parsed::Wrong(e) => Err(e),
        },
    });
    signals::wait_if_interrupted();
    exit::code(&result)
}

#[cfg(test)]
mod tests {
    use super::*;
    use clap::CommandFactory;

    /// Commands of a text's `sh` blocks: lines that start with the program's name, continuations joined.
    fn commands(text: &str) -> Vec<String> {
        let joined = text.replace("\\\n", " ");
        joined.lines().map(str::trim).filter(|l| l.starts_with("streetforward ")).map(str::to_string).collect()
    }

    #[test]
    fn the_flags_are_consistent() {
        Cli::command().debug_assert();
    }

    /// Every command that the documents show is one that the parser takes.
    #[test]
    fn documented_commands_parse() {
        for (name, text) in [
            ("README.md", include_str!("../../README.md")),
            ("docs/pictures.md", include_str!("../../docs/pictures.md")),
            ("docs/measuring.md", include_str!("../../docs/measuring.md")),
            ("tests/data/drive/README.md", include_str!("../../tests/data/drive/README.md")),
        ] {
            let list = commands(text);
            assert!(!list.is_empty(), "{name} shows no command");
            for line in list {
                let line = line.split(" #").next().unwrap_or_default();
                if let Err(e) = Cli::try_parse_from(line.split_whitespace()) {
                    panic!("{name}: {line}\n{e}");
                }
            }
        }
    }
}
