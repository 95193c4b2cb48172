//! Times an image and its gradients on the procedural street, as a training step sees them.
//!
//! `cargo run --release -p sf-splat --example backward_rates -- [repeats] [threads]`
//!
//! Forward and backward take turns, so that what else the machine does falls on both.

use std::time::Instant;

use sf_formats::scene::SplatSettings;
use sf_splat::{Gradients, ImageGradients, RenderOptions, Rendered, Renderer};
use street::{STEP, camera, scene};

#[path = "../tests/common/street.rs"]
mod street;

fn main() -> Result<(), Box<dyn std::error::Error>> {
    let mut numbers = std::env::args().skip(1).map(|a| a.parse::<usize>());
    let repeats = numbers.next().transpose()?.unwrap_or(30).max(1);
    let threads = numbers.next().transpose()?.unwrap_or(1);
    let mut renderer = Renderer::new(threads)?;
    println!("| Gaussians | view | aa | forward ms | backward ms | both / forward | seen | block updates |");
    println!("|---|---|---|---|---|---|---|---|");
    for (width, height) in [(168, 112), (252, 168)] {
        let scene = scene(width, height);
        let view = camera(width, height, 1.5 * STEP);
        let pixels = (width * height) as usize;
        // Any gradient will do: the work does not depend on it.
        let wave = |n: usize| (0..n).map(|i| ((i * 7919 % 1000) as f32 - 499.5) * 1e-3).collect::<Vec<f32>>();
        let (rgb, depth, alpha) = (wave(3 * pixels), wave(pixels), wave(pixels));
        let gradients = ImageGradients { rgb: &rgb, depth: &depth, alpha: &alpha };
        for aa in [false, true] {
            let settings = SplatSettings { aa, ..SplatSettings::default() };
            let (mut image, mut out) = (Rendered::default(), Gradients::default());
            let (mut forward, mut backward) = (Vec::with_capacity(repeats), Vec::with_capacity(repeats));
            for _ in 0..repeats {
                let start = Instant::now();
                renderer.render_into(&scene, &view, &settings, &RenderOptions::default(), &mut image)?;
                forward.push(start.elapsed().as_secs_f64() * 1e3);
                let start = Instant::now();
                renderer.backward(&scene, &gradients, &mut out)?;
                backward.push(start.elapsed().as_secs_f64() * 1e3);
            }
            let median = |v: &mut Vec<f64>| {
                v.sort_by(f64::total_cmp);
                v[v.len() / 2]
            };
            let (forward, backward) = (median(&mut forward), median(&mut backward));
            println!(
                "| {} | {width}x{height} | {aa} | {forward:.2} | {backward:.2} | {:.2} | {} | {} |",
                scene.len(),
                (forward + backward) / forward,
                out.opacity.iter().filter(|&&g| g != 0.0).count(),
                image.stats.block_updates,
            );
        }
    }
    Ok(())
}
