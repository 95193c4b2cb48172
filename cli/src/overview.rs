//! [`overview`]: one sheet that shows what the network made of a clip. A column per input frame, a row per kind
//! of picture, scales with numbers below.

use crate::reals::resized;
use crate::results::Results;
use crate::views;
use sf_formats::image_io::Rgb8;
use sf_formats::picture::{self, DepthScale, INK};
use sf_formats::{Result, label};
use sf_splat::{RenderOptions, Renderer};

/// Pixels around and between cells, and to the left for the rows' names.
const GAP: u32 = 4;
const LEFT: u32 = 74;
/// Cells are shrunk to this width.
const CELL: u32 = 320;
/// Most columns: of more frames every second, third and so on is shown.
const COLUMNS: usize = 8;
/// Share of the median depth that the novel view stands to the right, in hundredths.
const ASIDE: f64 = 0.06;

/// A row: its name (lines) and a picture per shown frame.
type Row = (&'static [&'static str], Vec<Rgb8>);

/// The sheet. Rows: input, depth, velocity, dynamic, the scene drawn at the input times, between them, and from
/// the side; true depth and velocity where they are known at the network's size.
///
/// Predicted and true depth have scales of their own, since a clip without poses is known up to scale; velocity has
/// one, since it is to be compared.
pub(crate) fn overview(results: &Results, renderer: &mut Renderer) -> Result<Rgb8> {
    let (out, scene) = (results.out, results.scene);
    let (size, n) = (results.size(), results.pixels());
    let frames: Vec<usize> = (0..out.shape.frames).step_by(out.shape.frames.div_ceil(COLUMNS).max(1)).collect();
    let part = |f: usize| f * n..(f + 1) * n;
    let of = |make: &dyn Fn(usize) -> Rgb8| frames.iter().map(|&f| make(f)).collect::<Vec<_>>();
    let input = |f: usize| Rgb8::new(size.0, size.1, results.prepared.images[3 * f * n..3 * (f + 1) * n].to_vec());

    let known: Vec<_> = results.truth.iter().filter(|t| (t.width, t.height) == size).collect();
    let known = if known.len() == out.shape.frames { known } else { Vec::new() };
    let velocity = results.velocity();
    let moving: Vec<[f32; 3]> = known.iter().filter_map(|t| t.velocity.as_deref()).flatten().copied().collect();
    let top = picture::top_speed(if moving.is_empty() { &velocity } else { &moving }, 1.0);
    let depth_scale = DepthScale::of(&out.depth);
    let true_depths: Vec<f32> = known.iter().flat_map(|t| &t.depth).copied().collect();
    let true_scale = DepthScale::of(&true_depths);

    let mut rows: Vec<Row> = vec![(&["input"], of(&input))];
    rows.push((&["depth"], of(&|f| picture::depth_colours(&out.depth[part(f)], size, depth_scale))));
    if !known.is_empty() {
        rows.push((&["true depth"], of(&|f| picture::depth_colours(&known[f].depth, size, true_scale))));
    }
    rows.push((&["velocity"], of(&|f| picture::velocity_wheel(&velocity[part(f)], size, top))));
    if known.iter().all(|t| t.velocity.is_some()) && !known.is_empty() {
        let truth = |f: usize| known[f].velocity.as_deref().unwrap_or_default();
        rows.push((&["true", "velocity"], of(&|f| picture::velocity_wheel(truth(f), size, top))));
    }
    rows.push((&["dynamic"], of(&|f| picture::dynamic_overlay(&input(f), &out.dynamic[part(f)]))));

    let mut draw = |time: f64, aside: f64| -> Result<Rgb8> {
        let camera = match scene.frames.iter().find(|f| f.time == time) {
            Some(f) => f.camera,
            None => scene.camera_at(time)?,
        };
        let shift = crate::args::Shift { right: aside, ..Default::default() };
        let now = scene.at(time, &scene.compose)?;
        let camera = views::shifted(&camera, &shift);
        Ok(views::rgb8(&renderer.render(&now, &camera, &scene.splat, &RenderOptions::default())?))
    };
    let time = |f: usize| scene.frames[f].time;
    rows.push((&["rendered"], frames.iter().map(|&f| draw(time(f), 0.0)).collect::<Result<_>>()?));
    let last = scene.frames.len() - 1;
    // Half way to the next frame; behind the last one half an interval, extrapolated.
    let middle = |f: usize| match (f, last) {
        (_, 0) => time(0),
        (f, l) if f == l => time(f) + 0.5 * (time(f) - time(f - 1)),
        (f, _) => 0.5 * (time(f) + time(f + 1)),
    };
    if last > 0 {
        rows.push((&["half a step", "later"], frames.iter().map(|&f| draw(middle(f), 0.0)).collect::<Result<_>>()?));
    }
    let aside = ASIDE * views::typical_depth(scene, &scene.frames[0].camera);
    rows.push((&["from the", "right"], frames.iter().map(|&f| draw(time(f), aside)).collect::<Result<_>>()?));

    let heads: Vec<String> = frames.iter().map(|&f| format!("frame {f}  {:.2} s", time(f))).collect();
    Ok(sheet(&rows, &heads, &scales(depth_scale, (!known.is_empty()).then_some(true_scale), top, aside)))
}

/// Legends in a column.
fn scales(depth: DepthScale, truth: Option<DepthScale>, top: f32, aside: f64) -> Vec<Rgb8> {
    let titled = |text: &str, body: Rgb8| {
        let mut out = picture::blank(body.width.max(label::width(text, 1)), body.height + 12, INK.0);
        label::draw(&mut out, (0, 0), text, INK.1, 1);
        picture::paste(&mut out, &body, (0, 12));
        out
    };
    let mut list = vec![titled("depth", picture::depth_legend(240, depth, "units"))];
    list.extend(truth.map(|t| titled("true depth", picture::depth_legend(240, t, "units"))));
    list.push(titled("velocity", picture::velocity_legend(64, top, "units/s")));
    let ramp: Vec<f32> = (0..120).map(|x| x as f32 / 119.0).collect();
    let bar = picture::dynamic_overlay(&picture::blank(120, 12, [128; 3]), &ramp.repeat(12));
    let mut bar_text = picture::blank(120, 23, INK.0);
    picture::paste(&mut bar_text, &bar, (0, 0));
    label::draw(&mut bar_text, (0, 16), "static", INK.1, 1);
    label::draw(&mut bar_text, (85, 16), "moving", INK.1, 1);
    list.push(titled("dynamic", bar_text));
    let note = format!("from the right: {aside:.2} units");
    list.push(titled(&note, picture::blank(1, 1, INK.0)));
    list
}

/// Puts the rows under their heads, names on the left and legends in lines below.
fn sheet(rows: &[Row], heads: &[String], legends: &[Rgb8]) -> Rgb8 {
    let cell = rows.iter().flat_map(|r| &r.1).next().map_or((1, 1), Rgb8::size);
    let cell = match cell.0 > CELL {
        true => (CELL, (u64::from(cell.1) * u64::from(CELL) / u64::from(cell.0)).max(1) as u32),
        false => cell,
    };
    let width = LEFT + heads.len() as u32 * (cell.0 + GAP) + GAP;
    // Legends flow from left to right.
    let (mut x, mut y, mut line) = (LEFT, 16 + rows.len() as u32 * (cell.1 + GAP) + 10, 0);
    let mut places = Vec::new();
    for l in legends {
        if x > LEFT && x + l.width + GAP > width {
            (x, y, line) = (LEFT, y + line + 10, 0);
        }
        places.push((x, y));
        (x, line) = (x + l.width + 28, line.max(l.height));
    }
    let right = legends.iter().zip(&places).map(|(l, p)| p.0 + l.width + GAP).max().unwrap_or(0);
    let mut out = picture::blank(width.max(right), y + line + 8, INK.0);
    for (column, head) in heads.iter().enumerate() {
        let at = i64::from(LEFT + column as u32 * (cell.0 + GAP));
        label::draw(&mut out, (at, 5), head, INK.1, 1);
    }
    for (r, (names, pictures)) in rows.iter().enumerate() {
        let top = 16 + r as u32 * (cell.1 + GAP);
        for (i, name) in names.iter().enumerate() {
            label::draw(&mut out, (i64::from(GAP), i64::from(top) + 3 + 10 * i as i64), name, INK.1, 1);
        }
        for (column, image) in pictures.iter().enumerate() {
            picture::paste(&mut out, &resized(image, cell), (LEFT + column as u32 * (cell.0 + GAP), top));
        }
    }
    for (l, p) in legends.iter().zip(places) {
        picture::paste(&mut out, l, p);
    }
    out
}
