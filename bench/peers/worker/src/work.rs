//! Parts of the network alone, on random values.
//!
//! | kind | sizes | what |
//! |---|---|---|
//! | `gemm` | m k n | int8 rows times int8 weights, bias, f32 out |
//! | `linear` | m k n | the same from f32 rows: rotated, quantized, multiplied |
//! | `conv` | h w c n | 3x3, f32 map in and out, ReLU |
//! | `attention` | frames tokens heads d lo hi | int8 attention of frames over the frames in sight |
//! | `block` | frames tokens dim heads lo hi | a transformer block in int8, ratio 4, norms folded, no q/k norm, rotary positions |

use crate::Work;
use sf_bench::{After, Sees, attention, block, conv_s8, linear_s8, product_s8};
use sf_ops::par::Pool;
use sf_ops::{Ctx, Kernels};

type Job = Box<dyn FnMut(Ctx)>;

struct Timed {
    pool: Pool,
    kernels: &'static Kernels,
    job: Job,
}

impl Work for Timed {
    fn run(&mut self) -> Result<(), String> {
        (self.job)(Ctx { pool: &self.pool, kernels: self.kernels });
        Ok(())
    }
}

pub(crate) fn open(args: &[String]) -> Result<Box<dyn Work>, String> {
    let [threads, kind, sizes @ ..] = args else { return Err("work THREADS KIND SIZE...".into()) };
    let threads = threads.parse().map_err(|_| format!("{threads}: not a number"))?;
    let sizes: Vec<i64> =
        sizes.iter().map(|s| s.parse().map_err(|_| format!("{s}: not a number"))).collect::<Result<_, _>>()?;
    let size = |i: usize| sizes[i] as usize;
    let pool = Pool::new(threads).map_err(|e| e.to_string())?;
    let kernels = Kernels::from_env()?;
    let ctx = Ctx { pool: &pool, kernels };
    let product = || (size(0), size(1), size(2));
    let sees = || Sees { lo: sizes[4] as i32, hi: sizes[5] as i32 };
    let job: Job = match (kind.as_str(), sizes.len()) {
        ("gemm", 3) => product_s8(ctx, product(), After::Bias).run,
        ("linear", 3) => linear_s8(ctx, product()).run,
        ("conv", 4) => conv_s8(ctx, (product(), size(3), (3, 1, 1))).run,
        ("attention", 6) => attention(ctx, (size(0), size(1), size(2), size(3)), sees(), true).run,
        ("block", 6) => block(ctx, (size(0), size(1), size(3), size(2) / size(3).max(1)), sees()).run,
        _ => return Err(format!("{kind} with {} sizes is not known", sizes.len())),
    };
    Ok(Box::new(Timed { pool, kernels, job }))
}
