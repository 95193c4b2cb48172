//! Times the renderer on a procedural street: milliseconds beside the counts that explain them.
//!
//! `cargo run --release -p sf-splat --example rates -- [repeats] [threads]`
//!
//! The scene of `tests/common/street.rs` is drawn from between the second and the third of its four frames.

use std::time::Instant;

use sf_formats::scene::SplatSettings;
use sf_splat::{RenderOptions, Rendered, Renderer};
use street::{STEP, camera, scene};

#[path = "../tests/common/street.rs"]
mod street;

fn main() -> Result<(), Box<dyn std::error::Error>> {
    let mut numbers = std::env::args().skip(1).map(|a| a.parse::<usize>());
    let repeats = numbers.next().transpose()?.unwrap_or(50).max(1);
    let threads = numbers.next().transpose()?.unwrap_or(2);
    let mut renderer = Renderer::new(threads)?;
    println!("| Gaussians | view | median ms | least ms | visible | entries | block updates |");
    println!("|---|---|---|---|---|---|---|");
    for source in [(252, 168), (518, 280)] {
        let scene = scene(source.0, source.1);
        for (width, height) in [(252, 168), (518, 280), (1280, 720)] {
            let view = camera(width, height, 1.5 * STEP);
            let mut out = Rendered::default();
            let mut ms = Vec::with_capacity(repeats);
            for _ in 0..repeats {
                let start = Instant::now();
                renderer.render_into(&scene, &view, &SplatSettings::default(), &RenderOptions::default(), &mut out)?;
                ms.push(start.elapsed().as_secs_f64() * 1e3);
            }
            ms.sort_by(f64::total_cmp);
            println!(
                "| {} | {width}x{height} | {:.2} | {:.2} | {} | {} | {} |",
                scene.len(),
                ms[repeats / 2],
                ms[0],
                out.stats.visible,
                out.stats.entries,
                out.stats.block_updates
            );
        }
    }
    Ok(())
}
