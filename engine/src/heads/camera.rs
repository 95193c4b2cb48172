//! Camera decoder and head: one pose per frame (network specification 1.3, camera head).
//!
//! On patch tokens: two residual units x + relu(L3 relu(L2 relu(L1 x))), the mean over patches, two linear
//! layers with ReLU, then translation, nine rotation numbers, and log focal lengths where the file has them.

use super::decoder;
use crate::arena::{carve, carved_len};
use crate::dims::Dims;
use crate::features::Features;
use crate::model::{self, Linear};
use crate::net::Net;
use crate::probe::Probe;
use crate::tables::{Tables, Tokens};
use sf_formats::Result;
use sf_ops::gemm::Act;
use sf_ops::mat::{Mat, MatMut};

/// Raw outputs of one frame.
#[derive(Clone, Copy, Debug, Default, PartialEq)]
pub(crate) struct RawCamera {
    /// Camera centre in the network's gauge.
    pub(crate) t: [f32; 3],
    /// Rotation numbers, row-major.
    pub(crate) nine: [f32; 9],
    /// log(fx / W), log(fy / H); zeros where the network has none.
    pub(crate) fov: [f32; 2],
}

/// Decoder output, two hidden layers of one frame's patches, decoder memory.
fn lens(camera: &model::Camera, d: &Dims, threads: usize) -> [usize; 4] {
    let width = camera.decoder.linear_out.weight.n;
    let decoded = d.frames * d.tokens * width;
    let hidden = d.patches * width;
    [decoded, hidden, hidden, decoder::scratch_len(&camera.decoder, d, d.tokens, threads)]
}

/// Values of working memory of [`run`].
pub(crate) fn scratch_len(camera: &model::Camera, d: &Dims, threads: usize) -> usize {
    carved_len(lens(camera, d, threads))
}

/// Poses of the frames of `x` into `out`; `d` counts those frames, of which `first` is the first.
pub(crate) fn run(
    net: Net,
    (d, tables): (&Dims, &Tables),
    (x, first): (Features, usize),
    scratch: &mut [f32],
    out: &mut [RawCamera],
    probe: &mut Probe,
) -> Result<()> {
    let camera = &net.model.weights().camera;
    let width = camera.decoder.linear_out.weight.n;
    let [decoded, h1, h2, work] = carve(scratch, lens(camera, d, net.ctx.pool.threads()));
    let job = decoder::Job { name: "camera", x, tokens: Tokens::WithRegisters };
    decoder::run(net, &camera.decoder, (d, tables), job, (work, decoded), probe)?;
    for (f, raw) in out.iter_mut().enumerate() {
        let x = &mut decoded[((f + 1) * d.tokens - d.patches) * width..][..d.patches * width];
        let n = d.patches;
        for [l1, l2, l3] in &camera.units {
            net.linear(l1, Act::Relu, Mat::new(x, n, width), MatMut::new(h1, n, width));
            net.linear(l2, Act::Relu, Mat::new(h1, n, width), MatMut::new(h2, n, width));
            net.linear_onto(l3, Act::Relu, None, Mat::new(h2, n, width), MatMut::new(x, n, width));
        }
        let (mean, a) = (&mut h1[..width], &mut h2[..width]);
        average(x, width, mean);
        let row = |l: &Linear, act, from: &[f32], to: &mut [f32]| {
            let n = to.len();
            net.linear(l, act, Mat::new(from, 1, from.len()), MatMut::new(to, 1, n));
        };
        row(&camera.mlps[0], Act::Relu, mean, a);
        row(&camera.mlps[1], Act::Relu, a, mean);
        *raw = RawCamera::default();
        row(&camera.t, Act::None, mean, &mut raw.t);
        row(&camera.rot, Act::None, mean, &mut raw.nine);
        if let Some(fov) = &camera.fov {
            row(fov, Act::None, mean, &mut raw.fov);
        }
        probe.guard(format_args!("camera"), &raw.t)?;
        probe.guard(format_args!("camera"), &raw.nine)?;
        probe.guard(format_args!("camera"), &raw.fov)?;
        probe.emit(format_args!("camera.t"), Some(first + f), &[3], &raw.t);
        probe.emit(format_args!("camera.rot9"), Some(first + f), &[9], &raw.nine);
    }
    Ok(())
}

/// Means of the columns of `x` `[rows, width]`, each summed from the first row to the last in f64.
fn average(x: &[f32], width: usize, out: &mut [f32]) {
    let n = x.len() / width;
    // A cache line of columns at a time.
    for (i, means) in out.chunks_mut(16).enumerate() {
        let mut sums = [0.0f64; 16];
        for row in x.chunks_exact(width) {
            for (sum, &v) in sums.iter_mut().zip(&row[16 * i..][..means.len()]) {
                *sum += f64::from(v);
            }
        }
        means.iter_mut().zip(sums).for_each(|(m, sum)| *m = (sum / n as f64) as f32);
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn means_are_those_of_the_columns_in_order() {
        for width in [1, 16, 21, 40] {
            let x: Vec<f32> =
                (0..7 * width).map(|i| ((i * 37 % 101) as f32 - 50.0) * 1.7e3f32.powi(i as i32 % 3)).collect();
            let mut have = vec![9.0; width];
            average(&x, width, &mut have);
            for c in 0..width {
                let sum: f64 = x.iter().skip(c).step_by(width).map(|&v| f64::from(v)).sum();
                assert_eq!(have[c], (sum / 7.0) as f32, "column {c} of {width}");
            }
        }
    }
}
