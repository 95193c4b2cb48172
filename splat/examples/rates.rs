//! Times the renderer on a procedural street: milliseconds beside the counts that explain them.
//!
//! `cargo run --release -p sf-splat --example rates -- [repeats] [threads]`, or `-- ply FOLDER`, which writes the two streets for other
//! renderers and measures nothing.
//!
//! With one thread on Linux the processor's own time is shown too: what other programs take does not count there.
//!
//! The scene of `tests/common/street.rs` is drawn from between the second and the third of its four frames.

use std::time::Instant;

use sf_formats::atomic::Overwrite;
use sf_formats::ply::export_ply;
use sf_formats::scene::SplatSettings;
use sf_splat::{RenderOptions, Rendered, Renderer};
use street::{STEP, camera, scene};

#[path = "../tests/common/street.rs"]
mod street;

/// Sizes of the source frames.
const SOURCES: [(u32, u32); 2] = [(252, 168), (518, 280)];

fn main() -> Result<(), Box<dyn std::error::Error>> {
    let mut args = std::env::args().skip(1);
    if args.next().as_deref() == Some("ply") {
        let folder = std::path::PathBuf::from(args.next().ok_or("ply FOLDER")?);
        for (width, height) in SOURCES {
            export_ply(&scene(width, height), &folder.join(format!("{width}x{height}.ply")), Overwrite::Yes)?;
        }
        return Ok(());
    }
    let mut numbers = std::env::args().skip(1).map(|a| a.parse::<usize>());
    let repeats = numbers.next().transpose()?.unwrap_or(50).max(1);
    let threads = numbers.next().transpose()?.unwrap_or(2);
    let mut renderer = Renderer::new(threads)?;
    println!("| Gaussians | view | median ms | least ms | least CPU ms | visible | entries | block updates |");
    println!("|---|---|---|---|---|---|---|---|");
    for source in SOURCES {
        let scene = scene(source.0, source.1);
        for (width, height) in [(252, 168), (518, 280), (1280, 720)] {
            let view = camera(width, height, 1.5 * STEP);
            let mut out = Rendered::default();
            let mut ms = Vec::with_capacity(repeats);
            let mut cpu = f64::INFINITY;
            for _ in 0..repeats {
                let (start, cpu_start) = (Instant::now(), cpu_ms());
                renderer.render_into(&scene, &view, &SplatSettings::default(), &RenderOptions::default(), &mut out)?;
                ms.push(start.elapsed().as_secs_f64() * 1e3);
                cpu = cpu.min(cpu_ms() - cpu_start);
            }
            ms.sort_by(f64::total_cmp);
            println!(
                "| {} | {width}x{height} | {:.2} | {:.2} | {} | {} | {} | {} |",
                scene.len(),
                ms[repeats / 2],
                ms[0],
                if threads == 1 && cpu.is_finite() { format!("{cpu:.2}") } else { "-".into() },
                out.stats.visible,
                out.stats.entries,
                out.stats.block_updates
            );
        }
    }
    Ok(())
}

/// Milliseconds that the calling thread has run; not a number where the system does not tell.
fn cpu_ms() -> f64 {
    let text = std::fs::read_to_string("/proc/thread-self/schedstat").unwrap_or_default();
    text.split(' ').next().and_then(|ns| ns.parse::<f64>().ok()).map_or(f64::NAN, |ns| ns * 1e-6)
}
