//! A scene as one page that a browser opens from the disk: the splats, a viewer in WebGL2 and pictures of the
//! source frames, nothing fetched from anywhere.
//!
//! The viewer is `cli/assets/viewer`: `page.html` is the frame, the scripts share one scope in the order of
//! [`SCRIPTS`]. Its copy of the composition rules is judged by `scripts/test-html.sh`: the browser draws every
//! picture of the strip again and compares.

use crate::reals::{Reals, resized};
use crate::views;
use half::f16;
use serde_json::{Value, json};
use sf_eval::metrics;
use sf_formats::config::{Extrapolate, SelfRule, Split};
use sf_formats::image_io::{self, Rgb8};
use sf_formats::picture::{self, DepthScale};
use sf_formats::{Error, Result, Scene};
use sf_splat::{RenderOptions, Renderer};
use std::path::Path;

const PAGE: &str = include_str!("../assets/viewer/page.html");
const STYLE: &str = include_str!("../assets/viewer/style.css");
const SCRIPTS: [&str; 6] = [
    include_str!("../assets/viewer/scene.js"),
    include_str!("../assets/viewer/draw.js"),
    include_str!("../assets/viewer/camera.js"),
    include_str!("../assets/viewer/controls.js"),
    include_str!("../assets/viewer/self_check.js"),
    include_str!("../assets/viewer/main.js"),
];
/// JPEG quality of the strip's pictures.
const QUALITY: u8 = 88;
/// Splats less opaque than this reach no pixel: an alpha below 1/255 is skipped.
const FAINT: f32 = 1.0 / 255.0;

/// A picture of the strip.
pub(crate) struct StripPicture {
    /// Seconds.
    pub(crate) time: f64,
    /// Source frame; none between them.
    pub(crate) frame: Option<usize>,
    /// As the rasterizer draws it from the camera of that time.
    pub(crate) rendered: Rgb8,
    /// As it was, where the clip is known.
    pub(crate) real: Option<Rgb8>,
    /// Of the rendered against the real one.
    pub(crate) psnr_db: Option<f64>,
}

/// Most pictures of a strip.
const STRIP: usize = 24;
/// Larger pictures are shrunk to this width.
const STRIP_WIDTH: u32 = 640;

/// Pictures for a page: every source frame and, where they are not too many, a time between each two and one
/// beyond the last; there the clip's picture nearest to the middle is shown, which the network never saw.
pub(crate) fn strip(scene: &Scene, reals: Option<&Reals>, threads: usize) -> Result<Vec<StripPicture>> {
    let n = scene.frames.len();
    let stride = n.div_ceil(STRIP).max(1);
    let mut moments: Vec<(f64, Option<usize>)> =
        (0..n).step_by(stride).map(|f| (scene.frames[f].time, Some(f))).collect();
    if n > 1 && 2 * n <= STRIP {
        for f in 0..n {
            let (a, step) = match scene.frames.get(f + 1) {
                Some(next) => (scene.frames[f].time, next.time - scene.frames[f].time),
                None => (scene.frames[f].time, scene.frames[f].time - scene.frames[f - 1].time),
            };
            let middle = a + 0.5 * step;
            let inside = |t: f64| t > a + Scene::SAME_TIME && t < a + step - Scene::SAME_TIME;
            match reals.and_then(|r| r.nearest(middle)).map(|r| r.time).filter(|t| inside(*t)) {
                Some(time) => moments.push((time, None)),
                // Beyond the end there is nothing to compare with.
                None if f + 1 < n => moments.push((middle, None)),
                None => {}
            }
        }
        moments.sort_by(|a, b| a.0.total_cmp(&b.0));
    }
    let mut renderer = Renderer::new(threads)?;
    let mut list = Vec::with_capacity(moments.len());
    for (time, frame) in moments {
        let camera = match frame {
            Some(f) => scene.frames[f].camera,
            None => scene.camera_at(time)?,
        };
        let now = scene.at(time, &scene.compose)?;
        let drawn = renderer.render(&now, &camera, &scene.splat, &RenderOptions::default())?;
        let size = (camera.width, camera.height);
        let real = reals.and_then(|r| r.nearest(time)).filter(|r| (r.time - time).abs() <= Scene::SAME_TIME);
        let real = real.map(|r| resized(&r.image, size));
        let unit = |image: &Rgb8| image.data.iter().map(|&b| f32::from(b) / 255.0).collect::<Vec<f32>>();
        let psnr_db = real.as_ref().and_then(|r| metrics::psnr(&drawn.rgb, &unit(r)));
        let small = |image: Rgb8| match image.width > STRIP_WIDTH {
            true => {
                let height = (u64::from(image.height) * u64::from(STRIP_WIDTH) / u64::from(image.width)).max(1);
                resized(&image, (STRIP_WIDTH, height as u32))
            }
            false => image,
        };
        list.push(StripPicture { time, frame, rendered: small(views::rgb8(&drawn)), real: real.map(small), psnr_db });
    }
    Ok(list)
}

/// A scene and the pictures of its clip, if that is given, as a page; gives the page and the number of pictures.
pub(crate) fn of_scene(scene: &Scene, clip: Option<&Path>, title: &str, threads: usize) -> Result<(String, usize)> {
    let reals = clip.map(|clip| Reals::open(clip, scene)).transpose()?;
    let strip = strip(scene, reals.as_ref(), threads)?;
    Ok((page(scene, title, &strip)?, strip.len()))
}

/// The page's text.
///
/// # Errors
/// Status 3 for a scene without frames, or with more than 65535.
fn page(scene: &Scene, title: &str, strip: &[StripPicture]) -> Result<String> {
    if scene.frames.is_empty() {
        return Err(Error::input("html", "the scene has no cameras: only a scene folder has them"));
    }
    if scene.frames.len() > usize::from(u16::MAX) {
        return Err(Error::input("html", format!("{} frames; a page holds 65535", scene.frames.len())));
    }
    let parts = Parts::of(scene);
    let (depth, typical) = depth_range(scene);
    let (from, last) = scene.time_range();
    // Beyond the last frame for most of an interval: what moves is extrapolated there.
    let to = last + 0.8 * (last - from) / (scene.frames.len().max(2) - 1) as f64;
    let own = match scene.compose.own {
        SelfRule::Own => "own",
        SelfRule::Neighbours => "neighbours",
    };
    let extrapolate = match scene.compose.extrapolate {
        Extrapolate::Mirror => "mirror",
        Extrapolate::Direct => "direct",
    };
    let frames = scene.frames.iter().map(|f| {
        let (c, k) = (&f.camera, &f.camera.k);
        json!({
            "time": f.time, "name": f.name, "width": c.width, "height": c.height,
            "fx": k.fx, "fy": k.fy, "cx": k.cx, "cy": k.cy, "camera_to_world": c.pose.to_rows(),
        })
    });
    let encode = |image: &Rgb8| -> Result<String> { Ok(base64(&image_io::encode_jpeg(image, QUALITY)?)) };
    let mut pictures = Vec::with_capacity(strip.len());
    for p in strip {
        pictures.push(json!({
            "time": p.time,
            "frame": p.frame,
            "rendered": encode(&p.rendered)?,
            "real": p.real.as_ref().map(encode).transpose()?,
            "psnr_db": p.psnr_db,
        }));
    }
    let moving: Vec<[f32; 3]> = parts.moving.iter().map(|&(i, _)| scene.velocity(i)).collect();
    let info = json!({
        "schema": "streetforward.page/1",
        "title": title,
        "static": parts.still.len(),
        "moving": parts.moving.len(),
        "frames": frames.collect::<Value>(),
        "time": { "from": from, "to": if scene.frames.len() > 1 { to } else { from } },
        "compose": { "window": scene.compose.window.max(1), "own": own, "extrapolate": extrapolate },
        "splat": {
            "aa": scene.splat.aa, "a_max": scene.splat.a_max, "eps2d": scene.splat.eps2d, "near": scene.splat.near,
        },
        "depth": { "near": depth.near, "far": depth.far, "typical": typical },
        "top_speed": picture::top_speed(&moving, 1.0),
        "ramp": picture::depth_ramp(64),
        "pictures": pictures,
    });
    let mut text = String::from(PAGE);
    // The markers of the page itself are replaced before anything with foreign text comes in, the last ones first.
    let info = info.to_string().replace('<', "\\u003c");
    let escaped = title.replace('&', "&amp;").replace('<', "&lt;");
    for (marker, value) in [
        ("{{splats}}", base64(&parts.bytes(scene))),
        ("{{script}}", SCRIPTS.join("\n")),
        ("{{style}}", STYLE.into()),
        ("{{scene}}", info),
        ("{{title}}", escaped),
    ] {
        text = text.replacen(marker, &value, 1);
    }
    Ok(text)
}

/// Which splats the page holds and with what share of their opacity.
struct Parts {
    /// Index and opacity; these exist always.
    still: Vec<(usize, f32)>,
    /// Index and opacity; these exist near their frame's time.
    moving: Vec<(usize, f32)>,
}

impl Parts {
    fn of(scene: &Scene) -> Parts {
        let (mut still, mut moving) = (Vec::new(), Vec::new());
        for i in 0..scene.len() {
            let (p, opacity) = (scene.dynamic[i], scene.gaussians.opacity[i]);
            let shares = match scene.compose.split {
                Split::Hard if p > scene.compose.tau => [0.0, opacity],
                Split::Hard => [opacity, 0.0],
                Split::Soft => [(1.0 - p) * opacity, p * opacity],
            };
            for (list, share) in [&mut still, &mut moving].into_iter().zip(shares) {
                if share >= FAINT {
                    list.push((i, share));
                }
            }
        }
        Parts { still, moving }
    }

    /// The sections that `readSplats` of `scene.js` describes.
    fn bytes(&self, scene: &Scene) -> Vec<u8> {
        let g = &scene.gaussians;
        let all = || self.still.iter().chain(&self.moving);
        let n = self.still.len() + self.moving.len();
        let mut out = Vec::with_capacity(28 * n + 16 * self.moving.len());
        let byte = |v: f32| (v.clamp(0.0, 1.0) * 255.0).round() as u8;
        let short = |v: f32| f16::from_f32(v.clamp(-65504.0, 65504.0)).to_le_bytes();
        out.extend(all().flat_map(|&(i, _)| g.mean[i]).flat_map(f32::to_le_bytes));
        out.extend(all().flat_map(|&(i, _)| g.scale[i]).flat_map(short));
        pad(&mut out);
        for &(i, _) in all() {
            let q = g.quat[i];
            let norm = q.iter().map(|v| v * v).sum::<f32>().sqrt();
            out.extend(q.map(|v| ((v / norm * 127.0).round() as i8) as u8));
        }
        for &(i, opacity) in all() {
            // An opacity that is drawn must not round to one that is not.
            out.extend(g.colour[i].map(byte).into_iter().chain([byte(opacity).max(1)]));
        }
        out.extend(all().map(|&(i, _)| byte(scene.dynamic[i])));
        pad(&mut out);
        out.extend(self.moving.iter().flat_map(|&(i, _)| [scene.v_fwd[i], scene.v_bwd[i]]).flatten().flat_map(short));
        pad(&mut out);
        out.extend(self.moving.iter().flat_map(|&(i, _)| (scene.source[i] as u16).to_le_bytes()));
        pad(&mut out);
        out
    }
}

/// To a multiple of four bytes.
fn pad(out: &mut Vec<u8>) {
    out.resize(out.len().next_multiple_of(4), 0);
}

/// Scale of depth pictures and the median depth, every splat seen from its own frame.
fn depth_range(scene: &Scene) -> (DepthScale, f32) {
    let to_camera: Vec<_> = scene.frames.iter().map(|f| f.camera.pose.inverse()).collect();
    // A few ten thousand give percentiles well enough.
    let step = (scene.len() / 32_768).max(1);
    let depth = |i: usize| {
        let m = scene.gaussians.mean[i].map(f64::from);
        let camera = to_camera.get(scene.source[i] as usize).or(to_camera.first())?;
        Some(camera.apply(glam::DVec3::from_array(m)).z as f32).filter(|z| *z > 1e-3)
    };
    let mut depths: Vec<f32> = (0..scene.len()).step_by(step).filter_map(depth).collect();
    let scale = DepthScale::of(&depths);
    let middle = depths.len() / 2;
    let typical = match depths.is_empty() {
        true => 10.0,
        false => *depths.select_nth_unstable_by(middle, f32::total_cmp).1,
    };
    (scale, typical)
}

/// Bytes as base64 text (RFC 4648, padded).
pub(crate) fn base64(bytes: &[u8]) -> String {
    const DIGITS: &[u8; 64] = b"ABCDEFGHIJKLMNOPQRSTUVWXYZabcdefghijklmnopqrstuvwxyz0123456789+/";
    let mut out = String::with_capacity(bytes.len().div_ceil(3) * 4);
    for chunk in bytes.chunks(3) {
        let word = chunk.iter().fold(0u32, |w, &b| w << 8 | u32::from(b)) << (8 * (3 - chunk.len()));
        for k in 0..4 {
            let digit = DIGITS[(word >> (18 - 6 * k)) as usize & 63];
            out.push(if k <= chunk.len() { char::from(digit) } else { '=' });
        }
    }
    out
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn base64_of_the_standard() {
        for (bytes, text) in
            [("", ""), ("f", "Zg=="), ("fo", "Zm8="), ("foo", "Zm9v"), ("foob", "Zm9vYg=="), ("foobar", "Zm9vYmFy")]
        {
            assert_eq!(base64(bytes.as_bytes()), text);
        }
        assert_eq!(base64(&[0xff, 0xef, 0xbe]), "/+++");
    }
}
