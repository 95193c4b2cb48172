use crate::common::{CANARY, Random, Same, close, everywhere};
use crate::tolerance::ATTENTION;
use sf_ops::attention::{FrameMask, attention, scratch_len};
use sf_ops::{Mat, MatMut, reference};

fn check(mask: FrameMask, heads: usize, d: usize, spread: f32) {
    let rows = mask.frames * mask.tokens;
    let c = heads * d;
    let mut r = Random::new((rows * 131 + c) as u64 ^ mask.hi as u64);
    let mut x = r.vec(rows * 3 * c);
    for row in x.chunks_mut(3 * c) {
        row[..2 * c].iter_mut().for_each(|v| *v *= spread);
    }
    let expected = reference::attention(Mat::new(&x, rows, 3 * c), heads, mask);
    let mut same = Same::default();
    everywhere(|ctx, name| {
        let need = scratch_len(&mask, heads, d, ctx.pool.threads());
        // Whatever the scratch held before must not matter: NaN would show.
        let mut scratch = vec![f32::NAN; need];
        let stride = c + 3;
        let mut y = vec![CANARY; rows * stride];
        let out = MatMut::with_stride(&mut y, rows, c, stride);
        attention(ctx, Mat::new(&x, rows, 3 * c), heads, mask, &mut scratch, out);
        assert!(y.chunks(stride).all(|row| row[c..] == [CANARY; 3]), "{name}: wrote between rows");
        let dense: Vec<f32> = y.chunks(stride).flat_map(|row| &row[..c]).copied().collect();
        let what = format!("{mask:?}, {heads} heads of {d}, {name}");
        if same.check(&dense, &what) {
            close(&dense, &expected, ATTENTION * spread.max(1.0), &what);
        }
        for a in 0..mask.frames {
            if mask.keys(a).is_empty() {
                let block = &dense[a * mask.tokens * c..][..mask.tokens * c];
                assert!(block.iter().all(|v| v.to_bits() == 0), "{what}: frame {a} sees nothing and must give 0");
            }
        }
    });
}

fn mask(frames: usize, tokens: usize, lo: i32, hi: i32) -> FrameMask {
    FrameMask { frames, tokens, lo, hi }
}

#[test]
fn head_widths() {
    for d in [4, 32, 56, 64, 68, 72, 80, 256] {
        check(mask(2, 37, -1, 1), 2, d, 1.0);
    }
}

#[test]
fn token_counts_around_tiles() {
    for tokens in [1, 2, 3, 4, 5, 6, 7, 11, 12, 13, 15, 16, 17, 31, 32, 33, 95, 96, 97, 193] {
        check(mask(1, tokens, 0, 0), 1, 8, 2.0);
    }
}

#[test]
fn horizons() {
    for k in [1, 2] {
        for (lo, hi) in [(0, k), (1, k), (-k, 0), (-k, -1), (-k, k)] {
            check(mask(4, 9, lo, hi), 2, 12, 1.0);
        }
    }
    check(mask(3, 20, -2, 2), 1, 16, 1.0);
    check(mask(3, 20, 0, 0), 1, 16, 1.0);
    // No frame sees any.
    check(mask(2, 5, 5, 9), 1, 4, 1.0);
    check(mask(2, 5, 2, 1), 1, 4, 1.0);
    check(mask(0, 5, 0, 0), 1, 4, 1.0);
}

#[test]
fn random_layouts() {
    let mut r = Random::new(77);
    for _ in 0..25 {
        let frames = 1 + r.below(5);
        let lo = r.below(2 * frames + 1) as i32 - frames as i32;
        let hi = lo + r.below(frames + 1) as i32 - 1;
        check(mask(frames, 1 + r.below(40), lo, hi), 1 + r.below(3), 4 * (1 + r.below(8)), 1.5);
    }
}

#[test]
fn large_scores_do_not_overflow() {
    // Scores up to some 2000: the running maximum must carry across tiles in both directions.
    check(mask(1, 150, 0, 0), 1, 16, 12.0);
}

#[test]
fn frame_keys() {
    let m = mask(4, 1, 0, 1);
    assert_eq!((0..4).map(|a| m.keys(a)).collect::<Vec<_>>(), [0..2, 1..3, 2..4, 3..4]);
    let m = mask(4, 1, -1, -1);
    assert!(m.keys(0).is_empty() && m.keys(3) == (2..3));
    let m = mask(3, 1, i32::MIN, i32::MAX);
    assert!((0..3).all(|a| m.keys(a) == (0..3)));
}
