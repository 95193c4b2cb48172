//! Numbers as pictures for people. Every picture has a scale that the caller knows and can print.
//!
//! * depth: logarithmic, so equal ratios of depth are equal steps of colour; near is light yellow, far is dark
//!   blue, no depth is black; neighbouring stops differ equally to the eye (a path through OKLab by its length);
//! * velocity: seen from above, direction is hue (forward green-yellow 90 degrees, right 0 degrees red),
//!   horizontal speed is saturation: white stands still, a full colour is the top of the scale or more;
//! * dynamic: the picture in gray, orange by probability;
//! * gray: linear.
//!
//! [`depth_legend`] and [`velocity_legend`] are the scales with numbers.

use crate::image_io::Rgb8;
use crate::label;
use crate::real::{exp, ln};

/// Near and far end of a depth picture, scene units.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct DepthScale {
    /// Drawn in the lightest colour, and everything nearer too.
    pub near: f32,
    /// Drawn in the darkest colour, and everything farther too.
    pub far: f32,
}

impl DepthScale {
    /// The 2nd and 98th percentile of all usable depths (positive and finite); several frames shown
    /// together need one scale over all of them.
    pub fn of(depths: &[f32]) -> DepthScale {
        let mut usable: Vec<f32> = depths.iter().copied().filter(|d| usable(*d)).collect();
        if usable.is_empty() {
            return DepthScale { near: 1.0, far: 2.0 };
        }
        let last = usable.len() - 1;
        let mut at = |q: f64| *usable.select_nth_unstable_by((last as f64 * q) as usize, f32::total_cmp).1;
        let (near, far) = (at(0.02), at(0.98));
        DepthScale { near, far: far.max(near * 1.01) }
    }
}

fn usable(depth: f32) -> bool {
    depth.is_finite() && depth > 0.0
}

/// Stops of the depth colours, far to near; OKLab lightness rises from 0.24 to 0.95.
const DEPTH_STOPS: [[f32; 3]; 17] = [
    [20.0, 21.0, 77.0],
    [37.0, 30.0, 101.0],
    [57.0, 38.0, 124.0],
    [81.0, 45.0, 144.0],
    [109.0, 48.0, 153.0],
    [138.0, 49.0, 151.0],
    [164.0, 50.0, 140.0],
    [188.0, 53.0, 125.0],
    [209.0, 62.0, 107.0],
    [227.0, 78.0, 91.0],
    [240.0, 100.0, 79.0],
    [251.0, 124.0, 73.0],
    [255.0, 149.0, 77.0],
    [255.0, 173.0, 92.0],
    [255.0, 197.0, 112.0],
    [255.0, 219.0, 133.0],
    [254.0, 241.0, 161.0],
];

/// Colour at `s` in 0..1 between stops.
fn between(stops: &[[f32; 3]], s: f32) -> [u8; 3] {
    let x = s.clamp(0.0, 1.0) * (stops.len() - 1) as f32;
    let i = (x as usize).min(stops.len() - 2);
    let f = x - i as f32;
    [0, 1, 2].map(|c| (stops[i][c] + (stops[i + 1][c] - stops[i][c]) * f + 0.5) as u8)
}

/// The depth colours from near to far in `count` steps.
pub fn depth_ramp(count: usize) -> Vec<[u8; 3]> {
    (0..count).map(|i| between(&DEPTH_STOPS, 1.0 - i as f32 / (count.max(2) - 1) as f32)).collect()
}

/// Depth `[height, width]` as a picture. Panics on a wrong count.
pub fn depth_colours(depth: &[f32], (width, height): (u32, u32), scale: DepthScale) -> Rgb8 {
    let (lo, hi) = (ln(scale.near.into()), ln(scale.far.into()));
    let data = depth.iter().flat_map(|&d| match usable(d) {
        true => between(&DEPTH_STOPS, ((hi - ln(d.into())) / (hi - lo)) as f32),
        false => [0; 3],
    });
    Rgb8::new(width, height, data.collect())
}

/// The depth colours from near (left) to far (right), logarithmic: a legend without numbers.
pub fn depth_key(width: u32, height: u32, scale: DepthScale) -> Rgb8 {
    let ratio = f64::from(scale.far) / f64::from(scale.near);
    let steps = f64::from(width.max(2) - 1);
    let row: Vec<f32> =
        (0..width).map(|x| (f64::from(scale.near) * exp(ln(ratio) * f64::from(x) / steps)) as f32).collect();
    depth_colours(&row.repeat(height as usize), (width, height), scale)
}

/// Background and text of legends and contact sheets.
pub const INK: ([u8; 3], [u8; 3]) = ([18, 20, 22], [224, 226, 228]);

/// An empty picture.
pub fn blank(width: u32, height: u32, colour: [u8; 3]) -> Rgb8 {
    Rgb8::new(width, height, colour.repeat(width as usize * height as usize))
}

/// Copies a picture into another at `(x, y)`; what lies outside is cut off.
pub fn paste(to: &mut Rgb8, from: &Rgb8, (x, y): (u32, u32)) {
    let columns = from.width.min(to.width.saturating_sub(x)) as usize;
    for row in 0..from.height.min(to.height.saturating_sub(y)) {
        let (a, b) = (3 * (row * from.width) as usize, 3 * ((y + row) as usize * to.width as usize + x as usize));
        to.data[b..b + 3 * columns].copy_from_slice(&from.data[a..a + 3 * columns]);
    }
}

/// A number with two digits that count: `0.25`, `3.8`, `40`, `1500`.
fn short(v: f64) -> String {
    match v {
        v if v >= 9.95 => format!("{v:.0}"),
        v if v >= 0.995 => format!("{v:.1}"),
        v => format!("{v:.2}"),
    }
}

/// The depth colours with numbers under them and the unit at the end, 23 pixels high.
pub fn depth_legend(width: u32, scale: DepthScale, unit: &str) -> Rgb8 {
    let mut out = blank(width, 23, INK.0);
    paste(&mut out, &depth_key(width, 12, scale), (0, 0));
    let ratio = ln(f64::from(scale.far) / f64::from(scale.near));
    let mut free = 0;
    // 1, 2, 5, 10, ... as far as they have room.
    let mut tick = |value: f64, text: &str| {
        let at = (ln(value / f64::from(scale.near)) / ratio * f64::from(width - 1)).round() as i64;
        let wide = i64::from(label::width(text, 1));
        let left = (at - wide / 2).clamp(0, (i64::from(width) - wide).max(0));
        if left >= free {
            free = left + wide + 6;
            paste(&mut out, &blank(1, 3, INK.1), (at.max(0) as u32, 11));
            label::draw(&mut out, (left, 16), text, INK.1, 1);
        }
    };
    let mut decade = 1e-6;
    let last = format!("{} {unit}", short(f64::from(scale.far)));
    let room = exp(ratio * (1.0 - f64::from(label::width(&last, 1) + 14) / f64::from(width))) * f64::from(scale.near);
    while decade < f64::from(scale.far) {
        for v in [1.0, 2.0, 5.0].map(|m| m * decade).into_iter().filter(|v| *v >= f64::from(scale.near) && *v < room) {
            tick(v, &short(v));
        }
        decade *= 10.0;
    }
    tick(f64::from(scale.far), &last);
    out
}

/// The velocity colours as a disc of `side` pixels, the speed of its rim and the direction of its top under it.
pub fn velocity_legend(side: u32, top: f32, unit: &str) -> Rgb8 {
    let lines = [format!("rim {} {unit}", short(top.into())), "up = ahead".to_owned(), "white = still".to_owned()];
    let width = lines.iter().map(|l| label::width(l, 1)).max().unwrap_or(0).max(side);
    let mut out = blank(width, side + 4 + 10 * lines.len() as u32, INK.0);
    let disc = velocity_key(side);
    let left = (width - side) / 2;
    for y in 0..side {
        for x in (0..side).filter(|&x| disc.pixel(x, y) != [0; 3]) {
            let at = 3 * (y * width + left + x) as usize;
            out.data[at..at + 3].copy_from_slice(&disc.pixel(x, y));
        }
    }
    for (i, line) in lines.iter().enumerate() {
        label::draw(&mut out, (0, i64::from(side) + 4 + 10 * i as i64), line, INK.1, 1);
    }
    out
}

/// Dynamic probability over a picture: its grays, darkened, turn orange by the probability. Panics on sizes
/// that differ.
pub fn dynamic_overlay(picture: &Rgb8, probability: &[f32]) -> Rgb8 {
    assert_eq!(probability.len() * 3, picture.data.len(), "one probability a pixel");
    let data = picture.data.chunks_exact(3).zip(probability).flat_map(|(p, &moving)| {
        let light = (0.299 * f32::from(p[0]) + 0.587 * f32::from(p[1]) + 0.114 * f32::from(p[2])) / 255.0;
        let moving = if moving.is_finite() { moving.clamp(0.0, 1.0) } else { 0.0 };
        let (still, strong) = (15.0 + 115.0 * light, 0.55 + 0.45 * light);
        [255.0, 140.0, 41.0].map(|c| (still + (c * strong - still) * moving + 0.5) as u8)
    });
    Rgb8::new(picture.width, picture.height, data.collect())
}

/// Colour of a hue (radians) and a saturation 0..1 at full brightness.
fn hue(angle: f32, saturation: f32) -> [u8; 3] {
    let h = (angle / std::f32::consts::TAU).rem_euclid(1.0) * 6.0;
    [0.0, 4.0, 2.0].map(|shift| {
        let k = (h + shift).rem_euclid(6.0);
        // A trapezoid: 1 within a sixth and a half of the primary, 0 opposite to it.
        let pure = ((k - 3.0).abs() - 1.0).clamp(0.0, 1.0);
        ((1.0 - saturation * (1.0 - pure)) * 255.0 + 0.5) as u8
    })
}

/// Velocity `[height, width]` in OpenCV world axes (x right, z forward) as a picture; `top` is the speed of a
/// full colour. Vertical motion is not shown. Panics on a wrong count.
pub fn velocity_wheel(velocity: &[[f32; 3]], (width, height): (u32, u32), top: f32) -> Rgb8 {
    let data = velocity.iter().flat_map(|v| {
        let speed = (v[0] * v[0] + v[2] * v[2]).sqrt();
        if !speed.is_finite() { [0; 3] } else { hue(v[2].atan2(v[0]), (speed / top).min(1.0)) }
    });
    Rgb8::new(width, height, data.collect())
}

/// The velocity colours as a disc seen from above (forward is up, right is right), its rim the top of
/// the scale: a legend.
pub fn velocity_key(side: u32) -> Rgb8 {
    let r = side.max(2) as f32 / 2.0;
    let at = |i: u32| (i as f32 + 0.5 - r) / r;
    let pixel = |x: f32, z: f32| if x * x + z * z > 1.0 { [f32::NAN; 3] } else { [x, 0.0, z] };
    let disc: Vec<[f32; 3]> = (0..side).flat_map(|y| (0..side).map(move |x| pixel(at(x), -at(y)))).collect();
    velocity_wheel(&disc, (side, side), 1.0)
}

/// The 98th percentile of the speeds above `floor`: a top for [`velocity_wheel`]; `floor` if there are
/// none.
pub fn top_speed(velocity: &[[f32; 3]], floor: f32) -> f32 {
    let speed = |v: &[f32; 3]| (v[0] * v[0] + v[2] * v[2]).sqrt();
    let mut fast: Vec<f32> = velocity.iter().map(speed).filter(|s| s.is_finite() && *s > floor).collect();
    if fast.is_empty() {
        return floor;
    }
    let i = ((fast.len() - 1) as f64 * 0.98) as usize;
    *fast.select_nth_unstable_by(i, f32::total_cmp).1
}

/// Values `[height, width]` from `low` (black) to `high` (white). Panics on a wrong count.
pub fn gray(values: &[f32], (width, height): (u32, u32), (low, high): (f32, f32)) -> Rgb8 {
    // A value that is not a number is black: `as` maps it to 0.
    let level = |v: f32| ((v - low) / (high - low) * 255.0 + 0.5).clamp(0.0, 255.0) as u8;
    Rgb8::new(width, height, values.iter().flat_map(|&v| [level(v); 3]).collect())
}

/// Pictures in rows of `columns`, four pixels of white between them, each in a cell of the largest size.
pub fn grid(pictures: &[&Rgb8], columns: usize) -> Rgb8 {
    const GAP: usize = 4;
    let columns = columns.clamp(1, pictures.len().max(1));
    let rows = pictures.len().div_ceil(columns).max(1);
    let cell_w = pictures.iter().map(|p| p.width).max().unwrap_or(1) as usize;
    let cell_h = pictures.iter().map(|p| p.height).max().unwrap_or(1) as usize;
    let (w, h) = (columns * (cell_w + GAP) - GAP, rows * (cell_h + GAP) - GAP);
    let mut data = vec![255u8; 3 * w * h];
    for (i, p) in pictures.iter().enumerate() {
        let (x, y) = ((i % columns) * (cell_w + GAP), (i / columns) * (cell_h + GAP));
        for (r, line) in p.data.chunks_exact(3 * p.width as usize).enumerate() {
            let at = 3 * ((y + r) * w + x);
            data[at..at + line.len()].copy_from_slice(line);
        }
    }
    Rgb8::new(w as u32, h as u32, data)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn depth_is_light_near_dark_far_black_without() {
        let scale = DepthScale { near: 2.0, far: 50.0 };
        let p = depth_colours(&[2.0, 50.0, 0.0, f32::NAN, 1.0, 900.0], (6, 1), scale);
        assert_eq!(p.pixel(0, 0), [254, 241, 161]);
        assert_eq!(p.pixel(1, 0), [20, 21, 77]);
        assert_eq!([p.pixel(2, 0), p.pixel(3, 0)], [[0; 3]; 2]);
        assert_eq!((p.pixel(4, 0), p.pixel(5, 0)), (p.pixel(0, 0), p.pixel(1, 0)));
        // Lightness falls all the way.
        let light = |p: [u8; 3]| 2 * u32::from(p[0]) + 5 * u32::from(p[1]) + u32::from(p[2]);
        let key = depth_key(64, 1, scale);
        assert!((1..64).all(|x| light(key.pixel(x, 0)) <= light(key.pixel(x - 1, 0))));
        let s = DepthScale::of(&(0..1000).map(|i| i as f32).chain([f32::NAN, -4.0]).collect::<Vec<_>>());
        assert!((s.near - 20.0).abs() < 2.0 && (s.far - 979.0).abs() < 2.0, "{s:?}");
        assert!(DepthScale::of(&[]).far > DepthScale::of(&[]).near);
    }

    /// OKLab of an sRGB colour.
    fn oklab(c: [f32; 3]) -> [f64; 3] {
        let linear = |v: f32| {
            let v = f64::from(v) / 255.0;
            if v <= 0.04045 { v / 12.92 } else { ((v + 0.055) / 1.055).powf(2.4) }
        };
        let [r, g, b] = c.map(linear);
        let root = |x: f64, y: f64, z: f64| (x * r + y * g + z * b).cbrt();
        let l = root(0.412_221_470_8, 0.536_332_536_3, 0.051_445_992_9);
        let m = root(0.211_903_498_2, 0.680_699_545_1, 0.107_396_956_6);
        let s = root(0.088_302_461_9, 0.281_718_837_6, 0.629_978_700_5);
        [
            0.210_454_255_3 * l + 0.793_617_785_0 * m - 0.004_072_046_8 * s,
            1.977_998_495_1 * l - 2.428_592_205_0 * m + 0.450_593_709_9 * s,
            0.025_904_037_1 * l + 0.782_771_766_2 * m - 0.808_675_766_0 * s,
        ]
    }

    #[test]
    fn depth_stops_are_equal_steps_to_the_eye() {
        let lab = DEPTH_STOPS.map(oklab);
        for pair in lab.windows(2) {
            let step = (0..3).map(|i| (pair[1][i] - pair[0][i]).powi(2)).sum::<f64>().sqrt();
            assert!((0.050..0.062).contains(&step), "{step}");
            assert!(pair[1][0] - pair[0][0] > 0.03, "lightness falls: {pair:?}");
        }
    }

    #[test]
    fn depth_is_logarithmic_and_its_legend_agrees() {
        let scale = DepthScale { near: 1.0, far: 100.0 };
        let p = depth_colours(&[1.0, 10.0, 100.0], (3, 1), scale);
        assert_eq!(p.pixel(1, 0), DEPTH_STOPS[8].map(|c| c as u8));
        let key = depth_key(101, 2, scale);
        assert_eq!(
            [key.pixel(0, 0), key.pixel(50, 1), key.pixel(100, 0)],
            [p.pixel(0, 0), p.pixel(1, 0), p.pixel(2, 0)]
        );
        let legend = depth_legend(201, scale, "units");
        assert_eq!(legend.size(), (201, 23));
        // A tick at 10, half way, and text under it.
        assert_eq!(legend.pixel(100, 13), INK.1);
        assert!((90..112).any(|x| legend.pixel(x, 18) == INK.1));
        assert_eq!(depth_ramp(17)[0], p.pixel(0, 0));
        assert_eq!(
            ["0.25", "1.0", "3.8", "10", "1500"],
            [0.25, 0.999, 3.84, 9.96, 1500.2].map(short).each_ref().map(String::as_str)
        );
    }

    #[test]
    fn what_moves_is_orange_on_gray() {
        let picture = blank(4, 1, [100, 150, 200]);
        let p = dynamic_overlay(&picture, &[0.0, 1.0, 0.5, f32::NAN]);
        let gray = p.pixel(0, 0);
        assert!(gray[0] == gray[1] && gray[1] == gray[2]);
        assert!(p.pixel(1, 0)[0] > 180 && p.pixel(1, 0)[2] < 40, "{:?}", p.pixel(1, 0));
        assert!(p.pixel(2, 0)[0] > gray[0] && p.pixel(2, 0)[0] < p.pixel(1, 0)[0]);
        assert_eq!(p.pixel(3, 0), gray);
        let mut sheet = blank(3, 2, [0; 3]);
        paste(&mut sheet, &picture, (2, 1));
        assert_eq!([sheet.pixel(2, 1), sheet.pixel(1, 1), sheet.pixel(2, 0)], [[100, 150, 200], [0; 3], [0; 3]]);
        let legend = velocity_legend(40, 12.0, "units/s");
        assert_eq!((legend.pixel(0, 0), legend.height), (INK.0, 74));
    }

    #[test]
    fn the_wheel_has_white_for_still_and_opposite_hues() {
        let v = [[0.0; 3], [5.0, 0.0, 0.0], [-5.0, 0.0, 0.0], [0.0, 9.0, 0.0], [50.0, 0.0, 0.0], [2.5, 0.0, 0.0]];
        let p = velocity_wheel(&v, (6, 1), 5.0);
        assert_eq!(p.pixel(0, 0), [255; 3]);
        assert_eq!(p.pixel(1, 0), [255, 0, 0]);
        assert_eq!(p.pixel(2, 0), [0, 255, 255]);
        assert_eq!(p.pixel(3, 0), [255; 3]);
        assert_eq!(p.pixel(4, 0), p.pixel(1, 0));
        assert_eq!(p.pixel(5, 0), [255, 128, 128]);
        assert_eq!(velocity_key(9).pixel(0, 0), [0; 3]);
        assert_eq!(top_speed(&v[..1], 0.5), 0.5);
        assert_eq!(top_speed(&v[..3], 0.5), 5.0);
    }

    #[test]
    fn gray_and_grid_put_values_where_they_belong() {
        let g = gray(&[0.0, 0.5, 1.0, 2.0, -1.0, f32::NAN], (3, 2), (0.0, 1.0));
        assert_eq!(g.data.chunks(3).map(|p| p[0]).collect::<Vec<_>>(), [0, 128, 255, 255, 0, 0]);
        let small = gray(&[0.0], (1, 1), (0.0, 1.0));
        let all = grid(&[&g, &small, &g], 2);
        assert_eq!(all.size(), (10, 8));
        assert_eq!(all.pixel(7, 0), [0; 3]);
        assert_eq!(all.pixel(8, 0), [255; 3]);
        assert_eq!(all.pixel(2, 6), [255; 3]);
        assert_eq!(all.pixel(1, 6), [128; 3]);
    }
}
