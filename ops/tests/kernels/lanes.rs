//! exp, sigmoid, gelu, relu, sums: accuracy of the scalar function, vector bodies with its bits.

use crate::common::{Random, Same, everywhere, same_bits};
use crate::tolerance::{ERF, EXP_ULPS, GELU_OF_X, SIGMOID};
use sf_ops::{Ctx, activation, elementwise, reference};

/// Zeros, subnormals, every exponent of both signs, infinities and a NaN; and the range where the functions bend.
fn values() -> Vec<f32> {
    let mut v =
        vec![0.0, -0.0, f32::INFINITY, f32::NEG_INFINITY, f32::MIN_POSITIVE, -f32::MIN_POSITIVE, 1e-45, f32::MAX];
    for e in 0..255u32 {
        for m in [0, 1, 0x2a_5555, 0x7f_ffff] {
            v.push(f32::from_bits(e << 23 | m));
            v.push(-f32::from_bits(e << 23 | m));
        }
    }
    v.extend((-120_000..=120_000).map(|i| i as f32 * 7.61e-4));
    v
}

fn ulp(x: f32) -> f32 {
    let x = x.abs().max(f32::MIN_POSITIVE);
    f32::from_bits(x.to_bits() + 1) - x
}

#[test]
fn exp_accuracy() {
    let mut worst = 0.0f32;
    for x in values() {
        let (y, expected) = (activation::exp(x), reference::exp(x));
        if x < -86.643_4 {
            assert!(y == 0.0, "exp({x}) = {y:e}");
        } else if expected.is_infinite() {
            assert!(y.is_infinite(), "exp({x}) = {y}");
        } else {
            let exact = sf_ops::trig::exp(f64::from(x));
            worst = worst.max(((f64::from(y) - exact).abs() / f64::from(ulp(expected))) as f32);
            assert!(worst <= EXP_ULPS, "exp({x}) = {y:e}, {worst} ulps from {exact:e}");
        }
    }
    println!("exp: {worst} ulps");
    assert!(activation::exp(f32::NAN).is_nan());
    assert_eq!(activation::exp(0.0), 1.0);
}

#[test]
fn gelu_sigmoid_erf_accuracy() {
    let (mut g, mut s, mut e) = (0.0f32, 0.0f32, 0.0f32);
    for x in values() {
        // Below that the product itself is subnormal.
        if x.is_finite() && x.abs() > 1e-30 {
            g = g.max((activation::gelu(x) - reference::gelu(x)).abs() / x.abs());
        }
        s = s.max((activation::sigmoid(x) - reference::sigmoid(x)).abs());
        e = e.max((activation::erf(x) - reference::erf(f64::from(x)) as f32).abs());
    }
    println!("gelu {g:e} of x, sigmoid {s:e}, erf {e:e}");
    assert!(g <= GELU_OF_X && s <= SIGMOID && e <= ERF, "gelu {g:e} of x, sigmoid {s:e}, erf {e:e}");
    assert_eq!(activation::gelu(f32::NEG_INFINITY), 0.0);
    assert_eq!(activation::gelu(f32::INFINITY), f32::INFINITY);
    assert_eq!(activation::gelu(0.0), 0.0);
    assert_eq!(activation::sigmoid(f32::NEG_INFINITY), 0.0);
    assert_eq!(activation::sigmoid(f32::INFINITY), 1.0);
    assert!(activation::gelu(f32::NAN).is_nan() && activation::sigmoid(f32::NAN).is_nan());
    // Beyond the fit: nothing below, x above.
    assert_eq!((activation::gelu(-5.5), activation::gelu(-1e30)), (0.0, 0.0));
    assert_eq!((activation::gelu(5.5), activation::gelu(1e30)), (5.5, 1e30));
    assert!(activation::erf(f32::NAN).is_nan());
}

#[test]
fn vector_bodies_have_the_bits_of_the_scalar_functions() {
    type Op = (&'static str, fn(Ctx, &mut [f32]), fn(f32) -> f32);
    let ops: [Op; 4] = [
        ("exp", elementwise::exp_in_place, activation::exp),
        ("sigmoid", elementwise::sigmoid_in_place, activation::sigmoid),
        ("gelu", elementwise::gelu_in_place, activation::gelu),
        ("relu", elementwise::relu, reference::relu),
    ];
    let all = values();
    for (what, vector, scalar) in ops {
        let expected: Vec<f32> = all.iter().map(|&x| scalar(x)).collect();
        everywhere(|ctx, name| {
            let mut y = all.clone();
            vector(ctx, &mut y);
            same_bits(&y, &expected, &format!("{what}, {name}"));
            for n in 0..50 {
                let mut y = all[100..100 + n].to_vec();
                vector(ctx, &mut y);
                same_bits(&y, &expected[100..100 + n], &format!("{what} of {n} values, {name}"));
            }
            let mut nan = [f32::NAN; 20];
            vector(ctx, &mut nan);
            assert!(nan.iter().all(|v| v.is_nan()), "{what} of NaN, {name}");
        });
    }
}

#[test]
fn sums() {
    for n in [0, 1, 15, 16, 17, 1000, 40_000] {
        let mut r = Random::new(n as u64);
        let (x, y) = (r.vec(n), r.vec(n));
        let expected: Vec<f32> = x.iter().zip(&y).map(|(a, b)| a + b).collect();
        let mut same = Same::default();
        everywhere(|ctx, name| {
            let mut out = vec![0.0; n];
            elementwise::add(ctx, &x, &y, &mut out);
            same_bits(&out, &expected, name);
            let mut z = x.clone();
            elementwise::add_assign(ctx, &mut z, &y);
            same.check(&z, name);
            same_bits(&z, &expected, name);
        });
    }
}
