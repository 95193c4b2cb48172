//! Times the renderer on a procedural street: milliseconds beside the counts that explain them.
//!
//! `cargo run --release -p sf-splat --example rates -- [repeats] [threads] [row]`, or `-- ply FOLDER`, which writes the two streets for other
//! renderers and measures nothing.
//!
//! The first line gives the multiply-add peak of these threads, so that rates of two machines can be compared; both modes take turns in
//! one run. With one thread on Linux the processor's own time is shown too: what other programs take does not count there.
//!
//! The scene of `tests/common/street.rs` is drawn from between the second and the third of its four frames.

use std::time::{Duration, Instant};

use sf_formats::atomic::Overwrite;
use sf_formats::ply::export_ply;
use sf_formats::scene::SplatSettings;
use sf_ops::{Kernels, peak};
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
    // One row alone, for a profile.
    let only = numbers.next().transpose()?;
    let mut renderer = Renderer::new(threads)?;
    let kernels = Kernels::best();
    let peak = peak::together(threads, || peak::flops_per_second(kernels, Duration::from_millis(200)));
    println!("{}, {threads} threads, f32 multiply-add peak {:.0} GFLOP/s", kernels.isa.name(), peak * 1e-9);
    println!(
        "| Gaussians | view | median ms | least ms | antialiased: median ms | least ms | least CPU ms | visible | entries \
         | block updates |"
    );
    println!("|---|---|---|---|---|---|---|---|---|---|");
    let mut row = 0;
    for source in SOURCES {
        let scene = scene(source.0, source.1);
        for (width, height) in [(252, 168), (518, 280), (1280, 720)] {
            row += 1;
            if only.is_some_and(|only| only != row) {
                continue;
            }
            let view = camera(width, height, 1.5 * STEP);
            let mut out = Rendered::default();
            let mut ms = [Vec::with_capacity(repeats), Vec::with_capacity(repeats)];
            let mut cpu = f64::INFINITY;
            // Both modes in turns; the first image of a size pays for its memory.
            for turn in 0..=repeats {
                for aa in [true, false] {
                    let settings = SplatSettings { aa, ..SplatSettings::default() };
                    let (start, cpu_start) = (Instant::now(), cpu_ms());
                    renderer.render_into(&scene, &view, &settings, &RenderOptions::default(), &mut out)?;
                    if turn > 0 {
                        ms[usize::from(aa)].push(start.elapsed().as_secs_f64() * 1e3);
                        cpu = if aa { cpu } else { cpu.min(cpu_ms() - cpu_start) };
                    }
                }
            }
            ms.iter_mut().for_each(|ms| ms.sort_by(f64::total_cmp));
            let [classic, aa] = &ms;
            println!(
                "| {} | {width}x{height} | {:.2} | {:.2} | {:.2} | {:.2} | {} | {} | {} | {} |",
                scene.len(),
                classic[repeats / 2],
                classic[0],
                aa[repeats / 2],
                aa[0],
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
