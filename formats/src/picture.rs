//! Numbers as pictures for people. Every picture has a scale that the caller knows and can print.
//!
//! * depth: linear in inverse depth (as a stereo camera's error is), near is light yellow, far is dark
//!   blue, no depth is black;
//! * velocity: seen from above, direction is hue (forward green-yellow 90 degrees, right 0 degrees red),
//!   horizontal speed is saturation: white stands still, a full colour is the top of the scale or more;
//! * gray: linear.

use crate::image_io::Rgb8;

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

/// Stops of the depth colours, far to near; lightness rises evenly.
const DEPTH_STOPS: [[f32; 3]; 7] = [
    [13.0, 14.0, 56.0],
    [44.0, 35.0, 116.0],
    [104.0, 44.0, 134.0],
    [168.0, 56.0, 122.0],
    [222.0, 89.0, 92.0],
    [250.0, 155.0, 84.0],
    [252.0, 236.0, 166.0],
];

/// Colour at `s` in 0..1 between stops.
fn between(stops: &[[f32; 3]], s: f32) -> [u8; 3] {
    let x = s.clamp(0.0, 1.0) * (stops.len() - 1) as f32;
    let i = (x as usize).min(stops.len() - 2);
    let f = x - i as f32;
    [0, 1, 2].map(|c| (stops[i][c] + (stops[i + 1][c] - stops[i][c]) * f + 0.5) as u8)
}

/// Depth `[height, width]` as a picture. Panics on a wrong count.
pub fn depth_colours(depth: &[f32], (width, height): (u32, u32), scale: DepthScale) -> Rgb8 {
    let (lo, hi) = (1.0 / scale.far, 1.0 / scale.near);
    let data = depth.iter().flat_map(|&d| match usable(d) {
        true => between(&DEPTH_STOPS, (1.0 / d - lo) / (hi - lo)),
        false => [0; 3],
    });
    Rgb8::new(width, height, data.collect())
}

/// The depth colours from near (left) to far (right), linear in inverse depth: a legend.
pub fn depth_key(width: u32, height: u32, scale: DepthScale) -> Rgb8 {
    let (lo, hi) = (1.0 / scale.far, 1.0 / scale.near);
    let steps = (width.max(2) - 1) as f32;
    let row: Vec<f32> = (0..width).map(|x| 1.0 / (hi + (lo - hi) * x as f32 / steps)).collect();
    depth_colours(&row.repeat(height as usize), (width, height), scale)
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
        assert_eq!(p.pixel(0, 0), [252, 236, 166]);
        assert_eq!(p.pixel(1, 0), [13, 14, 56]);
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
