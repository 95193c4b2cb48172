//! Prints the kernels that this CPU runs, under the cap in `STREETFORWARD_CPU`; fails with one line when the cap cannot be
//! met. `cargo run -p sf-ops --example kernels`

use sf_ops::Kernels;
use std::process::ExitCode;

fn main() -> ExitCode {
    match Kernels::from_env() {
        Ok(k) => {
            println!("{}: {}", k.isa.name(), k.rows().map(|(_, name)| name).join(", "));
            ExitCode::SUCCESS
        }
        Err(why) => {
            eprintln!("{why}");
            ExitCode::FAILURE
        }
    }
}
