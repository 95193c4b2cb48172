//! Every kernel against its naive twin, over tails and extremes; bits equal on every instruction set of this CPU
//! and on 1, 2 and 3 threads.

mod attention;
mod attention_s8;
mod common;
mod conv;
mod conv_s8;
mod exact;
mod gemm;
mod gemm_s8;
mod hash;
mod lanes;
mod quantize;
mod resize;
mod rows;
mod tolerance;
