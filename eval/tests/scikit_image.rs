//! PSNR and SSIM against values computed by scikit-image (`tests/data/make_metrics.py`).

use serde_json::Value;
use sf_eval::metrics::{psnr, psnr_masked};
use sf_eval::ssim::SsimMap;

#[test]
fn psnr_and_ssim_agree_with_scikit_image() {
    let fixture: Value = serde_json::from_str(include_str!("data/metrics.json")).unwrap();
    let numbers =
        |key: &str| -> Vec<f64> { fixture[key].as_array().unwrap().iter().map(|v| v.as_f64().unwrap()).collect() };
    let picture = |key: &str| numbers(key).iter().map(|v| (*v / 255.0) as f32).collect::<Vec<_>>();
    let (a, b) = (picture("a"), picture("b"));
    let mask: Vec<bool> = numbers("mask").iter().map(|&m| m == 1.0).collect();
    let size = (fixture["width"].as_u64().unwrap() as usize, fixture["height"].as_u64().unwrap() as usize);
    let map = SsimMap::new(&a, &b, size).unwrap();
    for (name, got) in [
        ("psnr", psnr(&a, &b).unwrap()),
        ("psnr_masked", psnr_masked(&a, &b, &mask).unwrap()),
        ("ssim", map.mean()),
        ("ssim_masked", map.mean_masked(&mask).unwrap()),
    ] {
        let want = fixture[name].as_f64().unwrap();
        // The pictures are f32 here and f64 there.
        assert!((got - want).abs() < 2e-6, "{name}: {got}, scikit-image has {want}");
    }
    for (got, want) in map.values().iter().zip(numbers("ssim_map_corner")) {
        assert!((got - want).abs() < 2e-6, "corner of the map: {got}, scikit-image has {want}");
    }
}

#[test]
fn equal_pictures_score_one_and_small_ones_nothing() {
    let picture: Vec<f32> = (0..7 * 7 * 3).map(|i| (i % 11) as f32 / 11.0).collect();
    assert!((SsimMap::new(&picture, &picture, (7, 7)).unwrap().mean() - 1.0).abs() < 1e-12);
    assert_eq!(SsimMap::new(&picture[..6 * 7 * 3], &picture[..6 * 7 * 3], (6, 7)), None);
}
